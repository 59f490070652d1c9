"""A learned policy in other forms: C, ONNX, TorchScript, safetensors, CSV, NPZ."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sb3_knntd.common.checks import check_path, check_word
from sb3_knntd.export.c99 import write_c
from sb3_knntd.export.frozen import Exportable, FrozenPolicy
from sb3_knntd.export.onnx_graph import write_onnx
from sb3_knntd.export.shared import write_safetensors
from sb3_knntd.export.tables import write_csv, write_npz
from sb3_knntd.export.torch_programs import write_torch_export, write_torchscript
from sb3_knntd.export.vectors import write_test_vectors

__all__ = ["FORMATS", "Exportable", "Format", "FrozenPolicy", "export_policy"]


@dataclass(frozen=True)
class Format:
    """
    A format of exported policies.

    :param suffix: of its files
    :param write: writes a policy to a path, and returns the files written; its keyword arguments are the options
    :param description: for the help
    :param needs: the module of the extra ``[export]`` that it needs; may be empty
    """

    suffix: str
    write: Callable[..., list[Path]]
    description: str
    needs: str = ""

    @property
    def options(self) -> list[str]:
        """Names of its options."""
        parameters = inspect.signature(self.write).parameters.values()
        return [each.name for each in parameters if each.kind is inspect.Parameter.KEYWORD_ONLY]


#: The formats by name.
FORMATS: dict[str, Format] = {
    "c": Format(".c", write_c, "C99, a header and a source, for controllers"),
    "onnx": Format(".onnx", write_onnx, "ONNX, for onnxruntime and others", "onnx"),
    "torchscript": Format(".pt", write_torchscript, "TorchScript, for torch in Python and C++"),
    "torch_export": Format(".pt2", write_torch_export, "torch.export, for torch"),
    "safetensors": Format(".safetensors", write_safetensors, "the whole policy, to share", "safetensors"),
    "csv": Format(".csv", write_csv, "points and values, for spreadsheets and MATLAB"),
    "npz": Format(".npz", write_npz, "points and values as arrays, for NumPy"),
}


def export_policy(
    policy: Exportable, path: str | Path, format: str, *, test_vectors: str | Path | None = None, **options: Any
) -> list[Path]:
    """
    :param policy: the policy
    :param path: file to write, with the format's suffix added if it has none
    :param format: name of one of :data:`FORMATS`
    :param test_vectors: a further file for random observations with their actions and values, see
        :func:`~sb3_knntd.export.vectors.write_test_vectors`
    :param options: of the format
    :return: the files written
    :raises ValueError: if the format, or an option, is unknown, or the format cannot hold this policy
    :raises ImportError: if the format needs a library that is not installed
    """
    check_word("format", format, FORMATS)
    kind = FORMATS[format]
    unknown = [option for option in options if option not in kind.options]
    if unknown:
        known = " and ".join(map(repr, kind.options)) or "none"
        raise ValueError(f"format={format!r} has no option {unknown[0]!r}; its options: {known}")
    target = check_path("path", path)
    if not target.suffix:
        target = target.with_name(f"{target.name}{kind.suffix}")
    if kind.needs and find_spec(kind.needs) is None:
        raise ImportError(f"format={format!r} needs {kind.needs}: pip install 'sb3-knntd[export]'")
    target.parent.mkdir(parents=True, exist_ok=True)
    written = kind.write(policy, target, **options)
    if test_vectors is not None:
        written.append(write_test_vectors(policy, check_path("test_vectors", test_vectors)))
    return written
