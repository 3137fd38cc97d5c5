"""Trees, lamp posts, bins and houses."""

import numpy as np

from sparsestreet.data.synthetic.parts import Part, at, limb
from sparsestreet.data.synthetic.shapes import Cylinder, Ellipsoid, box
from sparsestreet.data.synthetic.textures.facade import Facade, FacadeStyle
from sparsestreet.data.synthetic.textures.plain import Grainy, Plain


def tree(rng: np.random.Generator) -> list[Part]:
    """Returns a trunk with a crown of overlapping balls; origin at the foot."""
    height, reach = float(rng.uniform(5.0, 7.5)), float(rng.uniform(1.1, 1.6))
    stem = height - 1.6 * reach
    bark = Grainy((0.16, 0.11, 0.07), 0.12, 0.25, float(rng.uniform(0.0, 20.0)))
    parts = [Part(Cylinder(float(rng.uniform(0.11, 0.17)), stem / 2.0), bark, at(0.0, 0.0, stem / 2.0))]
    green = np.array([0.13, 0.24, 0.055]) * rng.uniform(0.75, 1.35) + rng.uniform(-0.015, 0.05) * np.array([1, 0.3, 0])
    for index in range(9):
        # The first ball is the core of the crown; the others sit around it.
        turn, tilt = 2.4 * index + rng.uniform(-0.4, 0.4), rng.uniform(-0.55, 0.9)
        away = 0.0 if index == 0 else 0.62 * reach
        x, y = away * np.cos(turn) * np.cos(tilt), away * np.sin(turn) * np.cos(tilt)
        z = height - reach + away * np.sin(tilt) * 1.3
        size = reach * (0.8 if index == 0 else rng.uniform(0.45, 0.62))
        shade = green * rng.uniform(0.88, 1.12)
        leaves = Grainy((float(shade[0]), float(shade[1]), float(shade[2])), 0.34, 0.32, float(rng.uniform(0.0, 20.0)))
        ball = Ellipsoid(np.array([size, size, size * rng.uniform(0.8, 1.0)], np.float32))
        parts.append(Part(ball, leaves, at(float(x), float(y), float(z), float(turn))))
    return parts


def lamp_post(towards: int) -> list[Part]:
    """Returns a post with an arm over the road; origin at the foot, ``towards`` is +1 if the road lies at +y."""
    steel, head = Plain((0.13, 0.14, 0.15), 0.15), Plain((0.55, 0.55, 0.52))
    return [
        Part(Cylinder(0.10, 0.4), steel, at(0.0, 0.0, 0.4)),
        Part(Cylinder(0.06, 3.3), steel, at(0.0, 0.0, 3.3)),
        limb((0.0, 0.0, 6.55), (0.0, towards * 1.3, 6.85), 0.045, steel),
        Part(box(0.22, 0.7, 0.12), head, at(0.0, towards * 1.55, 6.86)),
    ]


def bin_box(rng: np.random.Generator) -> list[Part]:
    """Returns a litter bin; origin at the foot."""
    color = ((0.05, 0.16, 0.08), (0.40, 0.10, 0.03), (0.10, 0.12, 0.16))[rng.integers(3)]
    return [
        Part(box(0.45, 0.45, 0.9), Grainy(color, 0.3, 0.05), at(0.0, 0.0, 0.45)),
        Part(box(0.52, 0.52, 0.1), Plain((0.05, 0.05, 0.05)), at(0.0, 0.0, 0.95)),
    ]


def house(rng: np.random.Generator, width: float, depth: float, road_side: int) -> list[Part]:
    """Returns a house with its front on the plane y = 0 and its body away from the road; centered in x.

    ``road_side`` is +1 if the road lies at +y.
    """
    walls = (
        (0.52, 0.42, 0.30), (0.46, 0.19, 0.13), (0.58, 0.53, 0.45), (0.40, 0.42, 0.45),
        (0.55, 0.36, 0.25), (0.62, 0.55, 0.38), (0.33, 0.15, 0.11), (0.36, 0.44, 0.42),
    )  # fmt: skip
    shops = ((0.35, 0.04, 0.04), (0.04, 0.10, 0.28), (0.03, 0.20, 0.12), (0.09, 0.06, 0.05), (0.45, 0.27, 0.04))
    wall = np.array(walls[rng.integers(len(walls))]) * rng.uniform(0.85, 1.12)
    light = float(rng.uniform(0.45, 0.68))
    storey = float(rng.uniform(2.9, 3.5))
    ground_floor = 3.7
    height = ground_floor + storey * int(rng.integers(2, 5)) + 0.7
    style = FacadeStyle(
        wall=(float(wall[0]), float(wall[1]), float(wall[2])),
        frame=(light, light, light) if rng.random() < 0.75 else (0.10, 0.07, 0.05),
        trim=(light, light * 0.97, light * 0.9),
        shop=shops[rng.integers(len(shops))],
        storey=storey,
        pitch=float(rng.uniform(2.0, 3.0)),
        window_width=float(rng.uniform(0.42, 0.62)),
        window_low=float(rng.uniform(0.24, 0.32)),
        window_high=float(rng.uniform(0.76, 0.84)),
        courses=float(rng.choice([0.0, 0.0, 0.25, 0.4])),
        has_shops=bool(rng.random() < 0.6),
        seed=int(rng.integers(2**31)),
        ground_floor=ground_floor,
    )
    body = box(width, depth, height)
    front = -road_side * depth / 2
    facade = Facade((width / 2, depth / 2, height / 2), style)
    parts = [Part(body, facade, at(0.0, front, height / 2.0))]
    parts.append(Part(box(width + 0.02, depth + 0.5, 0.3), Plain(style.trim), at(0.0, front, height - 0.45)))
    if rng.random() < 0.55:
        parts += _balconies(rng, style, width, height, road_side)
    return parts


def _balconies(rng: np.random.Generator, style: FacadeStyle, width: float, height: float, road_side: int) -> list[Part]:
    cells = max(round((width - 0.6) / style.pitch), 1)
    slab, rail = Plain(style.trim), Plain((0.12, 0.12, 0.13))
    parts = []
    for cell in sorted(rng.choice(cells, size=min(2, cells), replace=False)):
        x, z = (cell + 0.5) * width / cells - width / 2, style.ground_floor + 0.1
        while z + style.storey < height:
            parts.append(Part(box(0.85 * width / cells, 0.9, 0.14), slab, at(x, road_side * 0.45, z)))
            parts.append(Part(box(0.85 * width / cells, 0.06, 0.9), rail, at(x, road_side * 0.87, z + 0.5)))
            z += style.storey
    return parts
