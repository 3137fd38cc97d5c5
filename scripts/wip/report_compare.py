"""python /work/notes/report_compare.py [--base]: bytes of all that `report` writes, here against /work/wt-base.

Run in a worktree's top, in its environment (source env.sh). Fixture sweeps are written once by the base's own test helpers to
/tmp/report_compare/fixtures; each tree reports on its own copy (same folder names). --base draws the base's side anew.
Prints the files that differ and exits 1 if any does.
"""
import contextlib, filecmp, io, os, shutil, subprocess, sys
from pathlib import Path

TOP = Path("/tmp/report_compare")
BASE = Path("/work/wt-base")
FIXTURES = '''
import sys, dataclasses as d
from pathlib import Path
import numpy as np
from sparsestreet.records.summary import SUMMARY
from sparsestreet.records.novel import NOVEL, NovelRecord, NovelShift
from sparsestreet.records.presets import PRESETS, PresetRecord, RenderedAs
from sparsestreet.records.effects import EffectDecision
from sparsestreet.records.costs import update_costs, NodeCost, EffectGain
from sparsestreet.records.held_out import HELD_OUT_CURVE, HeldOutLook
from sparsestreet.records.quality import QUALITY, MetricSummary
from tests.report.sweep_folder import write_sweep, street_runs
from tests.evaluation.frames import *
top = Path(sys.argv[1])
write_sweep(top / "plain")
write_sweep(top / "bare", curves=False, failed=False)
def novel(off):
    return NovelRecord(command="evaluate", ramp=False, real_views=3, absent=None, shifts=tuple(
        NovelShift(offset=s * m, views=4, distances={"frechet_alexnet": 10.0 * m + s + off, "fid": 40.0 + m + off},
                   truth={"psnr_full": 22.0 - m + off, "lpips_alex": 0.1 * m}, true_views=4) for m in (1.0, 2.0) for s in (-1, 1)))
def presets(off, trained="exact"):
    return PresetRecord(command="evaluate", device="cpu", threads=2, views=3, noise=NOISE if off < 1 else d.replace(NOISE, quiet=False), rendered=tuple(
        RenderedAs(preset=n, trained=n == trained, quality={"psnr_full": 25.0 + off + i / 10, "psnr_human": 20.0, "psnr_vehicle": 21.0 + off}, psnr_to_exact=50.0 - i, frame_ms=10.0 - i, repeats=5)
        for i, n in enumerate(("exact", "fast", "fastest"))))
def plan(on, off):
    return tuple(EffectDecision(name=n, on=on or n == "sky", source="measured" if n != "sky" else "forced", reason="because", value=None if n == "sky" else 1.5 + off, unit="px", threshold=None if n == "sky" else 1.0, noise=0.1, numbers=1000 * (i + 1), ms=0.3 * i, gain=None if i == 1 else 0.5 + off) for i, n in enumerate(("sky", "exposure", "poses")))
def rich(name, folder, variants, seeds, scenes, split="every 10th frame from 0", plain=True):
    for v, (label, psnr, rows, cfg, kw) in enumerate(variants):
        for sc in range(scenes):
            for seed in seeds:
                if label.endswith("masks") and seed == seeds[-1] and sc == 0: continue
                off = 0.13 * seed + 0.7 * sc
                s = make_summary(label, seed, psnr + off, {k: n + 7 * seed for k, n in rows.items()}, scene=f"log {sc}", vehicle_psnr=22.0 + off if v != 1 else None,
                    milliseconds=40.0 - 5 * v + seed, training_psnr=psnr + 2 + off if v != 2 else None, config=cfg, split=split, **kw)
                extra = {n: MetricSummary(0.1 * v + 0.01 * seed + 0.1, 0.05, 6, 0) for n in ("lpips_alex_full", "lpips_alex", "ssim_gauss11_full", "psnr_near_lidar", "psnr_beyond_lidar", "psnr_human", "ssim_uniform7_human", "ssim_uniform7_vehicle", "psnr8_full", "psnr8_vehicle", "psnr8_human")}
                s = d.replace(s, quality={k: q | extra for k, q in s.quality.items()})
                s = d.replace(s, run=d.replace(s.run, effects=plan(v % 2 == 0, off)))
                if v == 1 and seed == seeds[0]: s = disturbed(s, "frames", "training")
                run = folder / f"{label}_{v}_{sc}_seed{seed}"
                SUMMARY.write(run, s)
                if name != "few":
                    NOVEL.write(run, novel(off + v)); PRESETS.write(run, presets(off + v / 3))
                    HELD_OUT_CURVE.write(run, [HeldOutLook(10.0 * t + v, t, psnr + off - x, None if v else 20.0 + off, 21.0) for t, x in enumerate((3.0, 0.8, 0.3, -0.1, 0.0), 1)])
                    update_costs(run, wall_seconds=30.0, phases={"train": 20.0, "prune": 5.0 + v, "start": 5.0 - v}, peak_host_mb=900.0 + v, peak_device_mb=None if v else 100.0,
                        nodes={"background": NodeCost(10, 0.1, 4.0, 3.0 - v / 2), "rigid": NodeCost(10, 0.1, 4.0, 1.0)}, effects={"sky": 0.5, "exposure": 0.1 + v},
                        step_ms={"scene": 1.0, "splat": 2.0 + v, "sky": 0.5, "losses": 0.25, "backward": 4.0, "optimizer": 0.5}, gains={"exposure": EffectGain(0.4 + off, None if v else 0.2, 0.1, 5)},
                        noise=NOISE if v else d.replace(NOISE, quiet=False))
B = {"background": 8000, "rigid": 2000}
rich("rich", top / "rich", [
    ("omnire", 27.0, B, {}, {"caps": {"background": 8000}}), ("omnire+paper", 26.8, {"background": 3000, "rigid": 900}, {}, {}),
    ("omnire+masks", 26.9, {"background": 5000, "rigid": 900}, {"callback.pruning.target": 0.5}, {}),
    ("omnire+masks", 26.5, {"background": 4000, "rigid": 900}, {"callback.pruning.target": 0.4}, {"steps": 40, "command": "train callback.pruning.target=0.4"}),
    ("omnire+random", 24.5, {"background": 3000, "rigid": 900}, {"sparsify.control": "as many drawn at random", "count_of": "../x"}, {}),
    ("pvg", 24.0, {"background": 12000}, {}, {"source": CodeVersion("fedcba9876543210", True)}),
    ("pvg+removal", 24.1, {"background": 3000}, {}, {"source": CodeVersion("fedcba9876543210", True)})], (0, 1, 2), 2)
rich("one", top / "one", [("streetgs", 27.0, B, {}, {"alarms": {"drawn": 3}, "absent": {"lpips_alex": "no weights"}}), ("streetgs+paper", 26.9, {"background": 3000, "rigid": 90}, {"data.log.width": 640, "split.stride": 5}, {"device": "cuda: x", "threads": 1}), ("streetgs+opacity", 26.9, {"background": 3000, "rigid": 90}, {}, {"data_hash": "ba9876543210"})], (0, 0 + 1), 1)
rich("whole", top / "whole", [("omnire", 27.0, B, {}, {}), ("omnire+paper", 26.9, {"background": 3000}, {"a.b": None}, {"training_seconds": None}), ("omnire+paper", 26.0, {"background": 2000}, {"a.b": 3}, {})], (0, 1), 2, split="none")
rich("few", top / "few", [("3dgs", 20.0, {"background": 100}, {}, {}), ("deformgs+removal", 19.0, {"background": 90}, {}, {})], (0,), 1)
'''
def stdout_of(report, arguments):
    buffer = io.StringIO()
    with contextlib.redirect_stdout(buffer), contextlib.redirect_stderr(buffer):
        code = report(arguments)
    return f"{arguments}: {code}\n{buffer.getvalue()}"
def draw(out, report):
    os.environ["COLUMNS"] = "200"
    shutil.rmtree(out, ignore_errors=True); shutil.copytree(TOP / "fixtures", out); os.chdir(out); said = []
    sweeps = sorted(p.name for p in out.iterdir())
    for name in sweeps:
        for protocol in ("drivestudio", "strict"):
            said.append(stdout_of(report, [f"sweep={name}", f"protocol={protocol}", f"figure={name}_{protocol}.png"]))
            if (out / name / "report").exists(): shutil.move(out / name / "report", out / f"{name}_report_{protocol}")
        for at, more in enumerate((["sections=all"], ["sections=mean"], ["sections=scenes", "baseline=streetgs"], ["baseline=omnire", "protocol=strict"])):
            os.environ["COLUMNS"] = ("200", "80", "120", "400")[at]
            said.append(stdout_of(report, [name, *more, f"markdown={name}_{at}.md", f"figure={name}_{at}.png", f"records={name}_{at}.jsonl"]))
    for table in ("table1_waymo", "table2_nuscenes", "table3_pruning", "table4_novel", "table5_ablation"):
        from sparsestreet.report.sweep import write_report
        write_report(out / "rich", table); shutil.move(out / "rich" / "report", out / f"rich_{table}")
    (out / "said.txt").write_text("\n".join(said).replace(str(out), "OUT"))
    for folder in sweeps: shutil.rmtree(out / folder)
def main():
    here = Path.cwd()
    if "--draw" in sys.argv:
        sys.path.insert(0, str(here))
        try: from sparsestreet.cli.commands.report import report
        except ImportError: from sparsestreet.cli.report import report
        draw(Path(sys.argv[2]), report); return 0
    if "--base" in sys.argv or not (TOP / "base").exists():
        shutil.rmtree(TOP, ignore_errors=True); (TOP / "fixtures").mkdir(parents=True)
        env = os.environ | {"PYTHONPATH": str(BASE)}
        subprocess.run([sys.executable, "-c", FIXTURES, TOP / "fixtures"], cwd=BASE, env=env, check=True)
        subprocess.run([sys.executable, __file__, "--draw", TOP / "base"], cwd=BASE, env=env, check=True)
    new = TOP / here.name
    subprocess.run([sys.executable, __file__, "--draw", new], env=os.environ | {"PYTHONPATH": str(here)}, check=True)
    files = sorted({p.relative_to(t) for t in (TOP / "base", new) for p in t.rglob("*") if p.is_file()})
    bad = [f for f in files if not ((TOP / "base" / f).exists() and (new / f).exists() and filecmp.cmp(TOP / "base" / f, new / f, shallow=False))]
    for f in bad: print("differs", f)
    print(f"{len(files)} files, {len(bad)} differ"); return bool(bad)
sys.exit(main())
