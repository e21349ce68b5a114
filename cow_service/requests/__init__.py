"""What a caller may ask: the bodies of `POST /simulate` and `POST /answer`. Checked once, here, then trusted."""

from cow_service.requests.motion import (
    CameraRequest,
    MotionRequest,
    MotionStepRequest,
    OtherMotionRequest,
    TrajectoryRequest,
)
from cow_service.requests.places import AskedRequest, GroundingRequest, InterventionRequest, ObjectRequest, PlaceRequest
from cow_service.requests.simulation import (
    PRIORITIES,
    AnswerRequest,
    FramesRequest,
    OptionRequest,
    Priority,
    SimulateRequest,
    Stage,
)
from cow_service.requests.values import Finite, Flag, ImageArtifact, ImageRef, ImageUrl, MaskRef, Whole

__all__ = [
    "PRIORITIES",
    "AnswerRequest",
    "AskedRequest",
    "CameraRequest",
    "Finite",
    "Flag",
    "FramesRequest",
    "GroundingRequest",
    "ImageArtifact",
    "ImageRef",
    "ImageUrl",
    "InterventionRequest",
    "MaskRef",
    "MotionRequest",
    "MotionStepRequest",
    "ObjectRequest",
    "OptionRequest",
    "OtherMotionRequest",
    "PlaceRequest",
    "Priority",
    "SimulateRequest",
    "Stage",
    "TrajectoryRequest",
    "Whole",
]
