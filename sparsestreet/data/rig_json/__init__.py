"""Reader of a rig that somebody describes by hand: ``rig.json`` (docs/datasets/rig_json.md)."""

from sparsestreet.data.rig_json.reader import RigJsonReader

__all__ = ["RigJsonReader"]
