"""Tables as they are printed and written."""

import pytest
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from sparsestreet.report import figure, markdown, sections, tables
from tests.evaluation.frames import make_summary
from tests.report.test_sections import PLAIN_AND_OURS, STREETS, records, rig, street
from tests.typed import as_a


def text_of(found, baseline=None):
    return markdown(sections(found, baseline))


def test_markdown_reads_as_written_by_hand():
    lines = text_of(PLAIN_AND_OURS, "plain").splitlines()
    assert lines[0] == "### street (64x48; held out: every 10th frame from 0)"
    header, rule, plain, ours, difference = (line.split(" | ") for line in lines[2:7])
    assert len(header) == len(rule) == len(plain) == len(ours) == len(difference)
    assert header[:3] == ["| method", "runs", "PSNR"]
    assert plain[:3] == ["| plain", "n=2 (seed 0,1)", "26.00 ± 1.41"]
    assert ours[:3] == ["| ours", "n=2 (seed 0,1)", "25.75 ± 1.20"]
    assert difference[2] == "-0.25 ± 0.21"
    assert difference[header.index("Gaussians")] == "29.2 ± 5.9 %"
    assert "**" not in text_of(PLAIN_AND_OURS, "plain")


def test_a_table_by_camera_has_rows_of_cameras():
    runs = [rig((25.0, 28.0, 22.0), 24.0, label=label) for label in ("ours", "plain")]
    text = text_of(records(*runs), "plain")
    table = text[text.index("### PSNR by camera") :].splitlines()[2:9]
    assert table[:4] == [
        "| method | plain | ours | ours against plain |",
        "| --- | ---: | ---: | ---: |",
        "| runs | n=1 (seed 0) | n=1 (seed 0) | n=1 (seed 0) |",
        "| camera 1 | 25.00 | 25.00 | +0.00 |",
    ]
    assert table[6] == "| camera 10 | 24.00 | 24.00 | +0.00 |"
    printed_text = printed(records(*runs), 80, "plain")
    assert "camera 1 beyond" in printed_text
    assert printed_text.count("runs ") == 2


def test_a_single_run_says_so_and_has_no_spread():
    text = text_of(PLAIN_AND_OURS[:1])
    assert "| plain | n=1 (seed 0) | 25.00 |" in text
    assert "n=1 has no spread" in text


def test_cells_of_fewer_runs_than_the_row_carry_their_number():
    assert "22.00 (n=1)" in text_of(records(make_summary(seed=0), make_summary(seed=1, vehicle_psnr=None)))
    assert "| - |" in text_of(records(make_summary(), make_summary("ours", vehicle_psnr=None)))


def test_counts_that_a_cap_held_down_are_marked():
    capped = make_summary("streetgs", caps={"background": 1000})
    text = text_of(records(capped, make_summary("streetgs+paper")), "streetgs")
    plain, paper, difference = (line for line in text.splitlines() if line.startswith("| streetgs"))
    assert plain.count("†") == difference.count("†") == 3  # the total and two nodes, nothing else
    assert "1,200 †" in plain
    assert "100.0 % †" in difference
    assert "†" not in paper


def printed(found, width, baseline=None):
    console = Console(width=width)
    with console.capture() as capture:
        for part in tables(sections(found, baseline), width):
            console.print(part)
    return capture.get()


def test_a_few_methods_fit_a_terminal_of_80_characters():
    text = printed(PLAIN_AND_OURS, 80, "plain")
    for cell in ("26.00 ± 1.41", "25.75 ± 1.20", "-0.25 ± 0.21", "29.2 ± 5.9 %", "1,400 ± 283", "every 10th frame"):
        assert cell in text
    assert "…" not in text
    assert "mean ± sample sd over runs; n=1 has no spread and proves nothing below the noise" in text  # its whole width
    assert text.count("┏") == 1


def test_square_brackets_are_no_markup():
    text = printed(records(*(make_summary("m", config={"nodes": [name]}) for name in ("red", "blue"))), 200)
    assert 'nodes=["red"]' in text
    assert 'nodes=["blue"]' in text


SWEEP = records(*(make_summary("streetgs+removal", config={"schedule.removal_db": value}) for value in range(6)))


def test_many_variants_are_rows_where_there_is_room():
    title, found, notes = tables(sections(SWEEP), 200)
    table = as_a(Table, found)
    assert table.row_count == 6
    assert str(table.columns[0].header) == "method"
    assert "…" not in printed(SWEEP, 200)
    assert "held out" in str(title)
    assert "guards: none fired" in str(notes)


def test_many_variants_are_tables_below_each_other_where_there_is_none():
    text = printed(SWEEP, 80)
    assert text.count("┏") > 1
    assert all(f" schedule.removal_db={value} " in text for value in range(6))
    assert text.count("n=1 (seed 0) ") == 6
    assert "…" not in text
    assert text.count("held out:") == 1  # one title
    assert text.count("guards: none fired") == 1


def test_every_run_is_a_point_in_its_variants_color(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path: drawn.append((self, path)))
    runs = [street(*values) for values in STREETS]
    figure(records(*runs, make_summary("blind", psnr=None, training_psnr=30.0)), tmp_path / "runs.png")
    ((canvas, path),) = drawn
    assert path == tmp_path / "runs.png"
    ours, plain = canvas.axes[0].collections
    assert plain.get_offsets().tolist() == [[100, 30], [200, 32], [300, 31]]
    assert ours.get_offsets().tolist() == [[50, 29], [50, 32.5], [150, 30]]
    assert [text.get_text() for text in canvas.axes[0].get_legend().get_texts()] == ["ours (n=3)", "plain (n=3)"]
    with pytest.raises(ValueError, match="no run was evaluated on held-out views"):
        figure(records(make_summary(psnr=None, training_psnr=30.0)), tmp_path / "runs.png")
