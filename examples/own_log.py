"""Describe a log of your own to SparseStreet: writes DIR/rig.json beside its files. Change names and columns to yours.

python examples/own_log.py DIR
sparsestreet data check DIR

DIR/cameras.json     {"front": {"size": [w, h], "fx": f, "fy": f, "cx": c, "cy": c, "vehicle_from_camera": 4x4}, ...}
DIR/poses.csv        stamp,x,y,z,qw,qx,qy,qz of the vehicle in the world; stamps are whole nanoseconds
DIR/CAMERA/STAMP.png
DIR/lidar/STAMP.bin  rows of x, y, z, intensity (float32) in the vehicle's frame; may be absent
DIR/boxes.csv        stamp,track,class,x,y,z,length,width,height,yaw in the vehicle's frame; may be absent
"""

import csv
import json
import shlex
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation


def pose(x: str, y: str, z: str, rotation: Rotation) -> np.ndarray:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rotation.as_matrix(), [float(x), float(y), float(z)]
    return made


def rows(path: Path) -> list[list[str]]:
    return list(csv.reader(path.read_text().splitlines()))[1:] if path.exists() else []


def main(folder: Path) -> None:
    cameras, frames, vehicles, tracks = {}, [], [], {}
    for name, one in json.loads((folder / "cameras.json").read_text()).items():
        # OpenCV's calibration counts from the middle of the first pixel.
        lens = {"model": "opencv", "first_pixel": 0} | {key: one[key] for key in ("fx", "fy", "cx", "cy")}
        mount = {"vehicle_from_camera": one["vehicle_from_camera"]}
        cameras[name] = {"width": one["size"][0], "height": one["size"][1], "lens": lens} | mount
    for stamp, x, y, z, qw, qx, qy, qz in rows(folder / "poses.csv"):
        vehicles.append(pose(x, y, z, Rotation.from_quat([float(q) for q in (qx, qy, qz, qw)])))
        frame = {"stamp": int(stamp), "world_from_vehicle": vehicles[-1].tolist()}
        frame["images"] = {name: f"{name}/{stamp}.png" for name in cameras}
        lidar = f"lidar/{stamp}.bin"
        frames.append(frame | ({"lidar": lidar} if (folder / lidar).exists() else {}))
    number = {str(frame["stamp"]): index for index, frame in enumerate(frames)}
    for stamp, name, kind, x, y, z, *size, yaw in rows(folder / "boxes.csv"):
        track = tracks.setdefault(name, {"name": name, "class": kind, "size": [float(s) for s in size], "at": []})
        box = vehicles[number[stamp]] @ pose(x, y, z, Rotation.from_euler("z", float(yaw)))
        track["at"].append({"frame": number[stamp], "world_from_box": box.tolist()})
    rig = {"cameras": cameras, "frames": frames} | ({"boxes": list(tracks.values())} if tracks else {})
    (folder / "rig.json").write_text(json.dumps(rig | {"lidar": {"vehicle_from_lidar": np.eye(4).tolist()}}))
    found = f"frames: {len(frames)}, cameras: {len(cameras)}, tracks of boxes: {len(tracks)}"
    print(f"{folder / 'rig.json'}: {found}; now sparsestreet data check {shlex.quote(str(folder))}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
