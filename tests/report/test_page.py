"""The page of a sweep: one file, every number with its runs; in a browser where there is one."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sparsestreet.pictures.images import picture_path, write_png
from sparsestreet.records.run import CodeVersion, FailedRun, Machine
from sparsestreet.records.summary import HELD_OUT, QUALITY, Evaluation
from sparsestreet.report.collect import RunRecord
from sparsestreet.report.page import Page, comparison_data, html
from sparsestreet.report.sweep import write_report
from sparsestreet.report.tables import Cell, Grid
from sparsestreet.report.variants import variants
from tests.evaluation.frames import MACHINE, make_image, make_summary
from tests.report.sweep_folder import record, write_sweep
from tests.typed import there

pytestmark = pytest.mark.lengthy

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return write_report(write_sweep(tmp_path_factory.mktemp("sweep"))).folder / "index.html"


def test_all_files_are_there(page):
    assert {path.name for path in page.parent.iterdir()} == {
        "tables.md", "tables.tex", "tables.csv", "figures", "index.html"
    }  # fmt: skip


def test_nothing_comes_from_elsewhere(page):
    text = page.read_text()
    assert not re.findall(r"(?:src|href)=['\"](?!data:|#)[^'\"]*", text.replace('xlink:href="#', 'xlink:href="data:'))
    assert "default-src 'none'" in text
    assert "@import" not in text


def test_every_link_has_its_place(page):
    text = page.read_text()
    places = set(re.findall(r"\bid=['\"]([^'\"]+)['\"]", text))
    targets = set(re.findall(r"<a href='#([^']+)'", text))
    assert targets <= places
    assert {"run-streetgs_seed0", "run-streetgs+paper_seed0", "differences", "compare"} <= places
    assert "commit</dt><dd>0123456789abcdef" in text


def test_a_failed_folder_with_an_old_record_is_no_run(tmp_path):
    sweep = write_sweep(tmp_path, failed=False)
    (sweep / "streetgs+removal_seed0" / "failed.json").write_text(
        '{"format": 1, "label": "streetgs+removal", "seed": 0, "command": "", "error": "x", "trace": ""}'
    )
    text = write_report(sweep).folder.joinpath("tables.csv").read_text()
    assert "streetgs+removal_seed1" in text
    assert "streetgs+removal_seed0" not in text


def test_it_says_what_follows_from_it(page):
    """-0.2, -0.3, -0.4 dB of three streets, a quarter of the Gaussians."""
    (said,) = re.findall(r"<section id='verdict'>(.*?)</section>", page.read_text())
    assert "streetgs: the smallest within 0.3 dB is streetgs+removal, with 25 % of the Gaussians, -0.30 dB" in said


@pytest.mark.slow
def test_tables_are_sorted_and_marks_speak(page):
    from tests.browser import browser

    def column(index: int) -> list[str]:
        cells = f"[...document.querySelectorAll('#costs tbody tr')].map((row) => row.cells[{index}].textContent)"
        return shown.run(f"JSON.stringify({cells})")

    with browser() as shown:
        shown.open(f"file://{page}", 1280, 900)
        shown.wait("document.readyState === 'complete'")
        was = column(0)
        click = "document.querySelectorAll('#costs thead tr:last-child [role=button]')[2].click()"
        shown.run(click)
        assert column(2) == '["10,000","2,510","2,510"]'
        assert shown.run("document.querySelector('#costs [aria-sort=descending]').textContent") == "Gaussians"
        shown.run(click)
        assert column(2) == '["2,510","2,510","10,000"]'
        shown.run(click)
        assert column(0) == was
        shown.run("document.querySelector('figure').scrollIntoView()")
        mark = "document.querySelector('figure use > title').parentNode.getBoundingClientRect()"
        at = shown.run(f"(({{x, y, width, height}}) => [x + width / 2, y + height / 2])({mark})")
        shown.call("Input.dispatchMouseEvent", type="mouseMoved", x=at[0] + 5, y=at[1] + 5)
        shown.wait("!document.getElementById('says').hidden")
        assert shown.run("document.getElementById('says').textContent").startswith(
            "streetgs, street 0, seed 0: 25.000 dB"
        )
        # On paper nothing is cut off at the right, and what only the screen can do is gone.
        shown.call("Emulation.setEmulatedMedia", media="print")
        shown.call("Emulation.setDeviceMetricsOverride", width=1047, height=740, deviceScaleFactor=1, mobile=False)
        assert shown.run("document.documentElement.scrollWidth") <= 1047
        assert shown.run("getComputedStyle(document.querySelector('.compare .choice')).display") == "none"
        assert [one for one in shown.requests if not one.startswith(("file:", "data:"))] == []


@pytest.mark.lengthy
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open the page with: apt-get install chromium")
def test_it_works_in_a_browser(page, tmp_path):
    """The script fills the choices and shows truth and the pruned run; a link's target is open."""
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}"]
    address = f"file://{page}#run-streetgs_seed1"
    found = subprocess.run(
        [*command, "--virtual-time-budget=2000", "--window-size=390,800", "--dump-dom", address],
        capture_output=True, text=True, check=True, timeout=120,
    ).stdout  # fmt: skip
    options = re.findall(r"<option value=\"\d\"[^>]*>([^<]+)</option>", found)
    assert options[:3] == [f"street {seed}, seed {seed}, frame 5, camera 0" for seed in range(3)]
    assert options[3:7] == ["truth", "streetgs", "streetgs+removal", "control: streetgs+random"]
    assert len(re.findall(r"<img alt=\"[^\"]+\" src=\"data:image/webp", found)) == 2
    assert 'id="run-streetgs_seed1" open=""' in found
    assert 'id="run-streetgs_seed0" open' not in found


def one_run(name="a", **changes):
    """A run whose numbers are all different."""
    made = {"device": "cuda: big", "threads": 3, "steps": 1234, "source": CodeVersion("c0ffee", True), "scene": "a <b>",
            "split": "every 4th", "training_seconds": 12.34, "caps": {"rigid": 7000}, "command": "train x"}  # fmt: skip
    made |= {"machine": Machine("p", 9, "Linux arm64", "3.12", "2.9.1"), "config": {"b": 2.5, "a <": None}}
    measured = Evaluation("evaluate x", MACHINE, CodeVersion("beef", False), "cpu: other", 5)
    gaussians = {"background": 1000, "rigid": 2345}
    summary = make_summary("m", 8, 25.5, gaussians, alarms={"vanished": 1111}, evaluated=measured, training_psnr=31.25,
                           milliseconds=7.5, **made | changes)  # fmt: skip
    return RunRecord(Path(name), replace(summary, run=replace(summary.run, max_steps=5678)))


def entries(text):
    """What stands under each heading of a run."""
    found = re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text)
    assert len(dict(found)) == len(found)
    return dict(found)


def whole(**changes):
    page = {"title": "A <title>", "notes": [], "grids": [], "figures": [], "pictures": None, "records": [],
            "failures": []}  # fmt: skip
    return html(Page(**page | changes))


def test_every_entry_of_a_run_is_its_own():
    summary = one_run().summary
    text = whole(records=[one_run()])
    assert entries(text) == {
        "command": "train x",
        "commit": "c0ffee with uncommitted changes",
        "measured by commit": "beef",
        "trained on": "cpu: test, 3 threads, Linux arm64, torch 2.9.1",
        "scene": "a &lt;b&gt;, seed 8, held out: every 4th",
        "steps": "1,234 of 5,678",
        "training seconds": "12.3",
        "Gaussians": "background 1,000, rigid 2,345",
        "held down by a cap": "rigid 7,000",
        "bytes": f"{59 * 4 * 3345:,}",
        "ms a frame": f"7.500 ({summary.latency.protocol}; cuda: big)",
        "guards": "vanished 1,111",
        "held_out: psnr_full": "25.5 over 6 images",
        "held_out: ssim_uniform7_full": "0.8 over 6 images",
        "held_out: psnr_vehicle": "22 over 1 images",
        "training: psnr_full": "31.25 over 6 images",
        "training: ssim_uniform7_full": "0.8 over 6 images",
        "training: psnr_vehicle": "22 over 1 images",
    }
    key = summary.run.config_hash
    assert "<details id='run-a'><summary>a</summary>" in text
    assert f"<a href='#config-{key}'>configuration {key}</a>" in text
    settings = "a &lt;=None\nb=2.5\ndata.log.settings.seed=8\ndata.log.width=None\nschedule.max_steps=60\nseed=8"
    assert f"<details id='config-{key}'><summary>{key} (m)</summary><pre>{settings}</pre></details>" in text
    assert "<h1>A &lt;title&gt;</h1>" in text
    assert "<title>A &lt;title&gt;</title>" in text
    assert "1 runs with a record, 0 failed." in text


def test_a_run_with_nothing_to_say():
    clean = {"source": CodeVersion(None, None), "training_seconds": None, "caps": {}}
    record = one_run(**clean)
    source = replace(record.summary.evaluated, source=CodeVersion(None, None))
    guards = replace(record.summary.guards, alarms={})
    found = entries(whole(records=[replace(record, summary=replace(record.summary, evaluated=source, guards=guards))]))
    assert (found["commit"], found["measured by commit"], found["training seconds"]) == ("none", "none", "-")
    assert (found["held down by a cap"], found["guards"]) == ("none", "none fired")


def test_a_configuration_stands_once():
    one, other = one_run("one"), one_run("other", config={"b": 3.5})
    text = whole(records=[one, one_run("again"), other])
    assert re.findall(r"<details id='config-([^']+)'>", text) == [r.summary.run.config_hash for r in (one, other)]
    assert re.findall(r"<details id='run-([^']+)'>", text) == ["one", "again", "other"]


def test_a_number_leads_to_its_runs():
    """One run: to it. Several: to their list, which stands once. Nothing, or nobody's: nowhere."""
    grid = Grid(
        "some",
        "Some: more",
        (("", "arm"), ("novel <views>", "PSNR"), ("novel <views>", "PSNR, paper"), ("", "n"), ("", "x")),
        (
            (Cell("<plain>", runs=("a", "b")), Cell("-0.3", bold=True, runs=("a", "b")), Cell("29", published=True),
             Cell("7", runs=("b", "c")), Cell("-", runs=("c",))),
            (Cell("one", runs=("c",)), Cell("1", runs=("c",)), Cell(), Cell("2"), Cell("-", bold=True)),
        ),
        ("a <note>",),
    )  # fmt: skip
    text = whole(grids=[grid], notes=["for <all>"])
    assert "<section id='some'><h2>Some: more</h2>" in text
    assert (
        "<tr><th class='above' colspan='1'></th><th class='above' colspan='2'>novel &lt;views&gt;</th>"
        "<th class='above' colspan='2'></th></tr>"
    ) in text
    assert "<tr><th>arm</th><th>PSNR</th><th class=theirs>PSNR, paper</th><th>n</th><th>x</th></tr>" in text
    first, second = re.findall(r"<tr>(<td.*?)</tr>", text)
    assert first == (
        "<td><a href='#of-0'>&lt;plain&gt;</a></td><td><a href='#of-0'><b>-0.3</b></a></td>"
        "<td class=theirs>29</td><td><a href='#of-1'>7</a></td><td>-</td>"
    )
    assert second == (
        "<td><a href='#run-c'>one</a></td><td><a href='#run-c'>1</a></td><td>-</td><td>2</td><td><b>-</b></td>"
    )
    assert re.findall(r"<li id='(of-\d)'>(.*?)</li>", text) == [
        ("of-0", "<a href='#run-a'>a</a>, <a href='#run-b'>b</a>"),
        ("of-1", "<a href='#run-b'>b</a>, <a href='#run-c'>c</a>"),
    ]
    assert re.findall(r"<ul class='notes'><li>(.*?)</li></ul>", text) == ["for &lt;all&gt;", "a &lt;note&gt;"]
    assert "class='above'" not in whole(grids=[replace(grid, header=(("", "a"),) * 5)])
    assert "What numbers are of" not in whole(grids=[replace(grid, rows=grid.rows[1:])])


def test_an_exact_number_stands_behind_the_rounded_one():
    text = whole(grids=[Grid("a", "A", (("", "x"), ("", "y")), ((Cell("1.2", exact="1.2345 <"), Cell("2")),), ())])
    assert "<tr><td title='1.2345 &lt;'>1.2</td><td>2</td></tr>" in text


def test_columns_without_any_published_number_are_left_out():
    header = (("", "arm"), ("of", "x"), ("of", "x, paper"), ("of", "y"), ("of", "y, paper"))
    rows = ((Cell("a"), Cell("1"), Cell(), Cell(), Cell("7", published=True)), (Cell("b"), *[Cell()] * 4))
    text = whole(grids=[Grid("a", "A", header, rows, ())])
    assert re.findall(r"<th[^>]*>([^<]+)</th>", text) == ["of", "arm", "x", "y", "y, paper"]
    assert "<th class='above' colspan='3'>of</th>" in text
    assert "<tr><td>a</td><td>1</td><td>-</td><td class=theirs>7</td></tr>" in text


def test_the_verdict_comes_first_and_only_if_there_is_one():
    text = whole(summary_line=("<this> arm.", "And so on."))
    assert "<section id='verdict'><p>&lt;this&gt; arm.</p><p>And so on.</p></section>\n<nav>" in text
    assert "id='verdict'" not in whole()


def test_the_navigation_names_what_is_there():
    def links(text):
        return re.findall(r"<a href='#([^']+)'>([^<]+)</a>", re.findall(r"<nav>(.*?)</nav>", text)[0])

    last = [("runs", "Runs"), ("configurations", "Configurations")]
    assert links(whole()) == last
    grid = Grid("some", "Some & more: of it", (), (), ())
    failure = (Path("broken"), FailedRun(label="m", seed=3, command="train <y>", error="no <room>", trace="at <z>"))
    text = whole(grids=[grid], figures=[("A <caption>", "<svg></svg>")], pictures="[]", failures=[failure])
    named = [("some", "Some &amp; more"), ("figures", "Figures"), ("compare", "Pictures"), ("failed", "Failed runs")]
    assert links(text) == [*named, *last]
    assert all(f"id='{target}'" in text for target, _ in links(text))
    assert "0 runs with a record, 1 failed." in text
    assert "<details class='bad' id='run-broken'><summary>m, seed 3: no &lt;room&gt;</summary>" in text
    assert "<pre>train &lt;y&gt;\n\nat &lt;z&gt;</pre>" in text
    assert "<script type='application/json' id='pictures'>[]</script>" in text
    assert [f"id='choose-{name}'" in text for name in ("view", "left", "right")] == [True] * 3
    empty = whole()
    assert not any(f"id='{target}'" in empty for target in ("figures", "compare", "failed"))


def test_figures_have_their_own_width_and_one_heading():
    first, second = '<svg height="9pt" width="312.5pt" viewBox="x">', "<svg viewBox='y'>"
    text = whole(figures=[("one", first), ("<two>", second)])
    found = re.findall(r"<div class='drawing' tabindex='0' style='--natural: (.*?)'>(<svg.*?>)</div>", text)
    assert found == [("312.5pt", first), ("100%", second)]
    assert re.findall(r"<figcaption>(.*?)</figcaption>", text) == ["one", "&lt;two&gt;"]
    assert text.count("<h2 id='figures'>") == 1
    assert text.index("<h2 id='figures'>") < text.index("one</figcaption>")


@pytest.mark.parametrize(
    ("had", "seed", "shown"),
    [
        # Seed 0 is the lowest, and half of the variants lack it.
        ([("plain", 0), ("plain", 1), ("plain+removal", 1)], 1, ["plain", "plain+removal"]),
        # No seed is in two variants: the lowest, and no picture of another seed beside it.
        ([("plain", 0), ("plain+removal", 1)], 0, ["plain"]),
        ([("plain", 1), ("plain", 2), ("plain+removal", 2), ("plain+removal", 1)], 1, ["plain", "plain+removal"]),
    ],
)
def test_pictures_are_of_one_seed_that_most_arms_have(tmp_path, had, seed, shown):
    runs = []
    for label, number in had:
        folder = tmp_path / f"{label}_{number}"
        for kind in ("truth", "render"):
            write_png(picture_path(folder / "pictures", 5, 0, kind), np.zeros((3, 4, 3), dtype=np.uint8))
        runs.append(record(make_summary(label, number), str(folder)))
    (view,) = json.loads(there(comparison_data(variants(runs))))
    assert view["name"] == f"street, seed {seed}, frame 5, camera 0"
    assert [image["name"].partition(" (")[0] for image in view["images"]] == ["truth", *shown]


def test_the_psnr_below_a_picture_is_of_its_view(tmp_path):
    """Frame 5 has 31 dB in camera 0; other views of the run have other numbers."""
    for kind in ("truth", "render"):
        write_png(picture_path(tmp_path / "pictures", 5, 0, kind), np.zeros((3, 4, 3), dtype=np.uint8))
    QUALITY[HELD_OUT].write(tmp_path, [make_image(0, psnr=20.0), make_image(5, 1, psnr=25.0), make_image(5, psnr=31.0)])
    (view,) = json.loads(there(comparison_data(variants([record(make_summary("plain"), str(tmp_path))]))))
    assert view["images"][1]["label"] == "plain, 31.00 dB, 1,200 Gaussians"
