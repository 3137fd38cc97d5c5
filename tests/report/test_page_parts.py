"""What stands in the page of a sweep, entry by entry."""

import re
from dataclasses import replace
from pathlib import Path

from sparsestreet.records.failures import FailedRun
from sparsestreet.records.run import CodeVersion, Machine
from sparsestreet.records.summary import Evaluation
from sparsestreet.report import RunRecord
from sparsestreet.report.grid import Cell, Grid
from sparsestreet.report.page import Page, html
from tests.evaluation.frames import MACHINE, make_summary


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
    text = whole(verdict=("<this> arm.", "And so on."))
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
