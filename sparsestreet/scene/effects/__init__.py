"""Effects: what cameras and light do to the image of a scene, each in a module of its own.

``effect`` says what one is, ``linearized`` how all of a scene change an image together. The sky is an image behind the
splats, the affine map one of their colors, the exposure a gain for each image; lens and shutter are what a camera
brings, and what takes them away from it.
"""

from sparsestreet.scene.effects.affine import Affine, AffineSettings
from sparsestreet.scene.effects.box_poses import BoxPosesSettings
from sparsestreet.scene.effects.camera_poses import CameraPoses, CameraPosesSettings
from sparsestreet.scene.effects.dirt import DirtSettings
from sparsestreet.scene.effects.effect import Cost, Effect, EffectSettings, Exposed, Finding, Moment
from sparsestreet.scene.effects.exposure import Exposure, ExposureSettings
from sparsestreet.scene.effects.hood import HoodSettings
from sparsestreet.scene.effects.lens import Lens, LensSettings
from sparsestreet.scene.effects.linearized import LinearizedEffects, linearized
from sparsestreet.scene.effects.motion_blur import MotionBlur, MotionBlurSettings
from sparsestreet.scene.effects.plan import EffectPlan, plan_effects
from sparsestreet.scene.effects.shutter import RollingShutter, ShutterSettings
from sparsestreet.scene.effects.sky import Sky, SkySettings

__all__ = [
    "Affine",
    "AffineSettings",
    "BoxPosesSettings",
    "CameraPoses",
    "CameraPosesSettings",
    "Cost",
    "DirtSettings",
    "Effect",
    "EffectPlan",
    "EffectSettings",
    "Exposed",
    "Exposure",
    "ExposureSettings",
    "Finding",
    "HoodSettings",
    "Lens",
    "LensSettings",
    "LinearizedEffects",
    "Moment",
    "MotionBlur",
    "MotionBlurSettings",
    "RollingShutter",
    "ShutterSettings",
    "Sky",
    "SkySettings",
    "linearized",
    "plan_effects",
]
