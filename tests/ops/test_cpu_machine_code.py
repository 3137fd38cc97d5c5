"""Without lens and shutter the C++ projection is the machine code it would be if neither had been written.

The sources are compiled twice: as they are, and with the two headers of the effects reduced to the names that must
exist, without any function or member. The instance without effects comes out equal to the byte; those with effects do
not compile. The pixel loops include neither header.
"""

import platform
import shutil
import subprocess
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[2] / "sparsestreet" / "ops" / "cpu" / "src"
# Those of CMakeLists.txt that shape code.
FLAGS = ["-std=c++17", "-O3", "-fPIC", "-fopenmp", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast"]
ON_X86 = platform.machine() in ("x86_64", "AMD64")
TARGETS = {"baseline": [], **({"v4": ["-march=x86-64-v4", "-mprefer-vector-width=512"]} if ON_X86 else {})}
EFFECTS = {"none": "false, false", "lens": "true, false", "shutter": "false, true"}
EMPTY = {
    "lens.hpp": """
        #include "camera.hpp"
        namespace SPLAT_VARIANT {
        template <class V> struct LensJacobian;
        template <class V> struct LensPoint;
        }""",
    "shutter.hpp": """
        #include "footprint.hpp"
        namespace SPLAT_VARIANT {
        constexpr double SLOWEST_READOUT = 0;
        template <class V> struct MovingRow;
        template <class V, bool LENS, bool COLUMNS> struct Motion;
        }""",
}
INSTANCE = """
    #include "projection_backward.hpp"
    namespace SPLAT_VARIANT {
    using E = Effects<EFFECTS>;
    template bool project_rows<E, float>(Workspace<float>&, const View&, const Inputs<float>&, float*);
    template void backward_range<E, float>(const Workspace<float>&, const Camera<float>&, const Inputs<float>&,
                                           const Outputs<float>&, const Range&);
    }"""

pytestmark = [pytest.mark.slow, pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler")]


def folder(place: Path, effects: str, replaced: dict[str, str]) -> Path:
    """The sources with some headers replaced, and the file that instantiates the projection with these effects."""
    shutil.copytree(SOURCES, place)
    for name, text in (replaced | {"instance.cpp": INSTANCE.replace("EFFECTS", EFFECTS[effects])}).items():
        guarded = text if name.endswith(".cpp") else f"#pragma once{text}"
        (place / name).write_text(f"{guarded}\n", encoding="utf-8")
    return place


def compiled(place: Path, *options: str, file: str = "instance.cpp") -> subprocess.CompletedProcess:
    defined = ["-DSPLAT_VARIANT=variant", "-DSPLAT_TILE=16"]
    command = ["c++", *FLAGS, *defined, *options, file]
    return subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("target", TARGETS)
def test_without_effects_the_projection_is_the_same_machine_code(tmp_path, target):
    objects = []
    for name, replaced in (("with", {}), ("without", EMPTY)):
        place = folder(tmp_path / name, "none", replaced)
        made = compiled(place, *TARGETS[target], "-c", "-o", "instance.o")
        assert made.returncode == 0, made.stderr
        objects.append((place / "instance.o").read_bytes())
    assert len(objects[0]) > 10_000  # both functions are in it
    assert objects[0] == objects[1]


@pytest.mark.parametrize(("effects", "missing"), [("lens", "LensPoint"), ("shutter", "MovingRow")])
def test_with_effects_it_needs_what_was_taken_out(tmp_path, effects, missing):
    whole = folder(tmp_path / "with", effects, {})
    assert compiled(whole, "-fsyntax-only").returncode == 0
    reduced = compiled(folder(tmp_path / "without", effects, EMPTY), "-fsyntax-only")
    assert reduced.returncode != 0
    assert missing in reduced.stderr


def test_the_pixel_loops_know_neither_lens_nor_shutter():
    listed = {file: compiled(SOURCES, "-MM", file=file) for file in ("pixels.cpp", "rows.cpp")}
    assert all(made.returncode == 0 for made in listed.values())
    assert "blend.hpp" in listed["pixels.cpp"].stdout
    for header in EMPTY:
        assert header in listed["rows.cpp"].stdout
        assert header not in listed["pixels.cpp"].stdout
