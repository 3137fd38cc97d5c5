"""Effects: what cameras and light do to the image of a scene, each in a module of its own.

``effect`` says what one is, ``linearized`` how all of a scene change an image together. The sky is an image behind the
splats, the affine map one of their colors, the exposure a gain for each image; lens and shutter are what a camera
brings, and what takes them away from it.
"""

from sparsestreet.scene.effects.effect import (
    Cost,
    Effect,
    EffectPlan,
    EffectSettings,
    Exposed,
    Finding,
    LinearizedEffects,
    Moment,
    ProbedGain,
    linearized,
    plan_effects,
)
from sparsestreet.scene.effects.exposure import Affine, AffineSettings, Exposure, ExposureSettings
from sparsestreet.scene.effects.occluders import DirtSettings, HoodSettings
from sparsestreet.scene.effects.optics import (
    Lens,
    LensSettings,
    MotionBlur,
    MotionBlurSettings,
    RollingShutter,
    ShutterSettings,
)
from sparsestreet.scene.effects.poses import BoxPosesSettings, CameraPoses, CameraPosesSettings
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
    "ProbedGain",
    "RollingShutter",
    "ShutterSettings",
    "Sky",
    "SkySettings",
    "linearized",
    "plan_effects",
]
