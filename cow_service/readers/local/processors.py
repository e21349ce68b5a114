"""Processors of image-text models without their part for videos, which alone would need torchvision."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from transformers import AutoConfig, AutoProcessor, PreTrainedConfig, ProcessorMixin
from transformers.models.auto.processing_auto import PROCESSOR_MAPPING

_VIDEO = "video_processor"


def still(kind: type[ProcessorMixin]) -> Any:
    """The processor class without videos. It keeps its name, so that what it saves is a usual checkpoint."""

    def get_attributes(cls: type[Any]) -> list[str]:
        return [name for name in cast(Any, kind).get_attributes() if name != _VIDEO]

    return type(kind.__name__, (kind,), {"get_attributes": classmethod(get_attributes)})


def load_processor(folder: Path) -> ProcessorMixin:
    """The processor of a checkpoint's folder. Raises what transformers raises."""
    config: PreTrainedConfig = AutoConfig.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
    if type(config) not in PROCESSOR_MAPPING:
        return AutoProcessor.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
    kind: Any = PROCESSOR_MAPPING[type(config)]
    # PIL's image processors everywhere: with torchvision's the same image would give other numbers where that is
    # installed.
    return still(kind).from_pretrained(folder, local_files_only=True, trust_remote_code=False, backend="pil")
