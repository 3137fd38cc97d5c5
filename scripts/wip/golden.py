#!/usr/bin/env python3
"""golden.py WORKTREE OUT.json [NAMES]: tiny runs of ten configurations, hashes of the checkpoint's state dict."""
import hashlib, json, os, subprocess, sys, shutil, tempfile
from pathlib import Path
W, OUT = Path(sys.argv[1]).resolve(), sys.argv[2]
BASE = ["data.log.settings.num_frames=12","data.log.settings.width=64","data.log.settings.height=40","data.log.settings.num_cameras=2","data.lidar.beams=24","data.lidar.azimuth_steps=300"]
COMMON = ["effects.sky.resolution=8","schedule.max_steps=30","schedule.refine_in.every=5","schedule.mask_in.every=5","trainer.val_check_interval=30","evaluation.timing.warmup=1","evaluation.timing.repeats=2","evaluation.timing.rounds=1"]
BG=["node.background.num_points=2000","node.background.min_gaussians=200","node.background.max_gaussians=6000"]
RIGID=["node.rigid.points_per_instance=150","node.rigid.min_gaussians=60","node.rigid.max_gaussians=3000"]
PEOPLE=["node.smpl.body.num_vertices=500","node.smpl.min_gaussians=50","node.deformable.points_per_instance=100","node.deformable.min_gaussians=50"]
RUNS={
 "streetgs_removal":[*BG,*RIGID,"sparsify=removal","schedule.removal_db=0.0"],
 "streetgs_paper":[*BG,*RIGID,"sparsify=paper","capacity=paper"],
 "streetgs_effects":[*BG,*RIGID,"effects.exposure=on","effects.camera_poses=on","effects.box_poses=on"],
 "streetgs_maskgaussian":[*BG,*RIGID,"sparsify=maskgaussian"],
 "streetgs_mcmc":[*BG,*RIGID,"sparsify=mcmc"],
 "omnire":["method=omnire",*BG,*RIGID,*PEOPLE,"sparsify=removal","schedule.removal_db=0.0"],
 "3dgs":["method=3dgs",*BG],
 "deformgs":["method=deformgs"],
 "pvg":["method=pvg"],
 "moved":[*BG,*RIGID,"moved_views=beside"],
}
names=sys.argv[3:] or list(RUNS)
env=dict(os.environ); env.pop("PYTHONPATH",None)
e=(W/"env.sh")
def sh(args, **k):
    return subprocess.run(["bash","-c",f"source {e} && exec python -m sparsestreet "+" ".join(f"'{a}'" for a in args)],text=True,capture_output=True,**k)
T=Path("/work/notes/golden"); T.mkdir(exist_ok=True); street=T/"street"
if not street.exists():
    r=sh(["data","make",f"data.log.root={street}",*BASE]); print(r.stdout[-300:],r.stderr[-1500:])
out={}
for n in names:
    run=Path(tempfile.mkdtemp(dir=T))/"run"
    words=[w for w in RUNS[n]]
    points=[] if n in ("deformgs","pvg","moved") and False else [f"image_points.cache={T/'points'}"]
    r=sh(["train",f"data.log.root={street}",*BASE,*COMMON,*points,*words,f"out={run}"])
    if r.returncode: out[n]=f"FAILED {r.stderr[-800:]} {r.stdout[-300:]}"; print(n,out[n],flush=True); continue
    code=f"""
import torch,hashlib,sys
from pathlib import Path
c=torch.load(Path(r'{run}')/'checkpoints'/'last.ckpt',map_location='cpu',weights_only=False)
s=c['state_dict']; h=hashlib.sha256()
for k in sorted(s):
    v=s[k]; h.update(k.encode())
    if torch.is_tensor(v): h.update(str(tuple(v.shape)).encode()); h.update(v.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes() if v.numel() else b'')
    else: h.update(repr(v).encode())
print(h.hexdigest()[:16], len(s))
"""
    q=subprocess.run(["bash","-c",f"source {e} && exec python -c \"$CODE\""],env={**env,"CODE":code},text=True,capture_output=True)
    out[n]=q.stdout.strip() or q.stderr[-500:]
    print(n,out[n],flush=True); shutil.rmtree(run.parent)
Path(OUT).write_text(json.dumps(out,indent=1))
