"""Everything sceneprint raises on purpose.

    SceneprintError
      x FrameError              the caller's frame cannot be used; trying again cannot help
        - UnreadableFrame       its bytes do not decode to a depth image
        - InvalidIntrinsics     its camera is not a camera
        - InvalidPose           its pose is not a rigid transform
        - UselessFrame          it decodes, but there is nothing in it to sign
      x DatasetError            a folder or file that is no sequence of frames
      x ModelError
        - UnreadableModel       a model file that is none, or of another schema
        - ModelMismatch         signatures or artifacts of two models were compared
      x UnreadableGeometry        a geometry artifact that is missing, damaged or of another schema
      x TrainingError           too little data, or parameters that cannot be fitted
      x MissingDependency       an optional part of the machine is absent

A message says what happened, why, and what to do. Commands print it on one line
and end with exit code 2. `ValueError` and `TypeError` stay what they are in Python:
a mistake of the programmer who calls.
"""


class SceneprintError(Exception):
    """Base of every error raised on purpose."""


class FrameError(SceneprintError):
    """The caller's frame cannot be used."""


class UnreadableFrame(FrameError):
    """The bytes do not decode to a depth image."""


class InvalidIntrinsics(FrameError):
    """The intrinsics do not describe a camera."""


class InvalidPose(FrameError):
    """The pose is not a rigid transform."""


class UselessFrame(FrameError):
    """The frame decodes, but holds nothing that can be signed."""


class DatasetError(SceneprintError):
    """The folder or file is no sequence of frames."""


class ModelError(SceneprintError):
    """A model cannot be used."""


class UnreadableModel(ModelError):
    """The file is no model, is damaged, or has another schema."""


class ModelMismatch(ModelError):
    """Signatures or artifacts of two models were compared."""


class UnreadableGeometry(SceneprintError):
    """The bytes are no geometry artifact, are damaged, or have another schema."""


class TrainingError(SceneprintError):
    """A model cannot be trained from this data with these parameters."""


class MissingDependency(SceneprintError):
    """A library that this task needs cannot be imported on this machine."""
