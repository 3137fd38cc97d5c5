"""The page of a sweep: one file, every number with its runs; in a browser where there is one."""

import re
import shutil
import subprocess

import pytest

from sparsestreet.report.sweep import write_report
from tests.report.sweep_folder import write_sweep

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


def test_what_failed_stands_escaped(page):
    assert "streetgs+paper, seed 0: no &lt;memory&gt;" in page.read_text()


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
    (verdict,) = re.findall(r"<section id='verdict'>(.*?)</section>", page.read_text())
    assert "streetgs: the smallest within 0.3 dB is streetgs+removal, with 25 % of the Gaussians, -0.30 dB" in verdict


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
