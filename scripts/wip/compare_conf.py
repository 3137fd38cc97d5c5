"""Dump what every choice of method x experiment x preset x capacity resolves to, and compare two dumps key by key.

    python compare_conf.py dump OUT.json [PROCESSES]    in a worktree's environment
    EVERY=17 python compare_conf.py dump ...            a sample of them
    python compare_conf.py diff BASE.json NEW.json [IGNORED_PREFIX ...]

A dump holds of each choice the instantiated recipe (fields as nested dicts) and the rest of the resolved configuration,
for a log that is not read yet and for one of 240 training images.
"""

import hashlib
import itertools
import json
import multiprocessing
import os
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path

METHODS = ("3dgs", "deformgs", "omnire", "pvg", "streetgs")
PRESETS = ("default", "drivestudio", "drivestudio_legacy", "simulation")
CAPACITIES = ("small", "paper")
IMAGES = (None, 240)
RECIPE = ("node", "effects", "loss", "callback", "optimizer", "render", "image_points", "moved_views")
RULES = ("random", "opacity", "importance", "removal", "lightgaussian", "mini_splatting")
OURS = ("moved_views", "images", "rendering", "start", "density", "losses", "rates", "objects")
CLAIMS = ("node_aware", "global_pruning", "one_lambda", "background_pruning", "static_masks", "temporal_masks")
SPARSIFY = (
    "random", "opacity", "mcmc", "importance", "removal", "masks", "capped", "none", "paper_short", "paper",
    "maskgaussian", "uncapped",
)  # fmt: skip
EXPERIMENTS = (
    *(f"sparsify={name}" for name in SPARSIFY),
    "experiment=strong_masks",
    "experiment=one_schedule",
    "experiment=table/global_pruning",
    *(f"experiment=claim/{name}" for name in CLAIMS),
    *(f"experiment=ours/{name}" for name in OURS),
    *(f"experiment=rule/{name}" for name in RULES),
)
# What a one-line option of the base is written as today (name of the choice -> overrides); the name stays the base's.
WRITTEN: dict[str, list[str]] = {}
EXTRA = ("schedule=paper", "schedule=paper sparsify=paper", "assignment=all_rigid", "effects.sky=off")


def plain(value):
    if is_dataclass(value) and not isinstance(value, type):
        return {"_": type(value).__name__, **{one.name: plain(getattr(value, one.name)) for one in fields(value)}}
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Path):
        return str(value)
    if callable(value) and hasattr(value, "__qualname__"):
        return value.__qualname__
    if isinstance(value, (set, frozenset)):
        return sorted(map(str, value))
    if type(value).__module__.startswith("sparsestreet"):
        return {"_": type(value).__name__, **{key: plain(one) for key, one in sorted(vars(value).items())}}
    return f"<{type(value).__name__}>"


def choices():
    for method, preset, capacity in itertools.product(METHODS, PRESETS, CAPACITIES):
        for experiment in (*EXPERIMENTS, *EXTRA):
            yield " ".join((f"method={method}", f"preset={preset}", f"capacity={capacity}", experiment))


def words_of(choice):
    return [written for word in choice.split() for written in WRITTEN.get(word, [word])]


def describe(choice):
    from omegaconf import OmegaConf

    try:
        from sparsestreet.cli.runs.run import recipe_of, with_images
        from sparsestreet.cli.config.compose import configuration
    except ImportError:
        from sparsestreet.cli.assemble import recipe_of, with_images
        from sparsestreet.cli.compose import configuration
    try:
        from sparsestreet.cli.config.effect_words import with_effect_keys
    except ImportError:
        try:
            from sparsestreet.cli.effect_words import with_effect_keys
        except ImportError:
            from sparsestreet.cli.config.validate import with_effect_keys
    from hydra import compose

    found = {}
    try:
        with configuration():
            # Hydra's own value of the moment would make every dump another.
            cfg = compose("train", [*with_effect_keys(words_of(choice)), "out=o/run", "folder=o/run"])
        for images in IMAGES:
            known = with_images(cfg, images)
            recipe = plain(recipe_of(known))
            rest = OmegaConf.to_container(known, resolve=True)
            label = f"images={images}"
            for key, part in recipe.items():
                found[f"{label} recipe.{key}"] = part
            for key, part in rest.items():
                if key not in RECIPE:
                    found[f"{label} {key}"] = part
    except Exception as error:  # noqa: BLE001 - an error is what this choice resolves to
        return choice, {"error": f"{type(error).__name__}: {str(error).splitlines()[0][:150]}"}
    return choice, found


def dump(out, processes):
    parts, table = {}, {}
    with multiprocessing.Pool(processes) as pool:
        for number, (choice, found) in enumerate(pool.imap(describe, list(choices())[:: int(os.environ.get("EVERY", "1"))], chunksize=5)):
            table[choice] = {}
            for key, tree in found.items():
                text = json.dumps(tree, sort_keys=True)
                digest = hashlib.sha1(text.encode()).hexdigest()[:12]
                parts[digest] = tree
                table[choice][key] = digest
            if number % 200 == 0:
                print(number, choice, flush=True)
    Path(out).write_text(json.dumps({"choices": table, "parts": parts}))
    print(len(table), "choices,", sum("error" in one for one in table.values()), "refused,", len(parts), "parts")


def flat(tree, prefix=""):
    if isinstance(tree, dict) and tree:
        for key, value in tree.items():
            yield from flat(value, f"{prefix}.{key}" if prefix else key)
    elif isinstance(tree, list) and tree:
        for number, value in enumerate(tree):
            yield from flat(value, f"{prefix}.{number}")
    else:
        yield prefix, tree


def diff(base, new, ignored):
    old, now = (json.loads(Path(path).read_text()) for path in (base, new))
    differences, compared = {}, 0
    for choice in old["choices"]:
        one, other = old["choices"][choice], now["choices"].get(choice)
        if other is None and len(now["choices"]) < len(old["choices"]):
            continue  # a sample
        if other is None:
            differences.setdefault("choice is gone", []).append(choice)
            continue
        for key in one.keys() | other.keys():
            compared += 1
            if one.get(key) == other.get(key):
                continue
            before = dict(flat(old["parts"][one[key]], key)) if key in one else {}
            after = dict(flat(now["parts"][other[key]], key)) if key in other else {}
            for place in before.keys() | after.keys():
                short = place.partition(" ")[2] or place
                if before.get(place) != after.get(place) and not short.startswith(tuple(ignored)):
                    text = f"{short}: {before.get(place, 'ABSENT')!r} -> {after.get(place, 'ABSENT')!r}"
                    differences.setdefault(text, []).append(choice)
    for text, where in sorted(differences.items()):
        print(f"{len(where):5d} x {text}    e.g. {where[0]}")
    print(f"{compared} sections compared, {len(differences)} differences")
    return 1 if differences else 0


if __name__ == "__main__":
    command, *rest = sys.argv[1:]
    if command == "dump":
        dump(rest[0], int(rest[1]) if len(rest) > 1 else 2)
    else:
        sys.exit(diff(rest[0], rest[1], rest[2:]))
