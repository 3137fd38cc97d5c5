"""Bodies of people: a surface on a skeleton, either built in or from the user's file."""

from sparsestreet.scene.body.builtin import BuiltinBody
from sparsestreet.scene.body.smpl_file import SmplFile
from sparsestreet.scene.body.template import Body, BodyTemplate, surface

__all__ = ["Body", "BodyTemplate", "BuiltinBody", "SmplFile", "surface"]
