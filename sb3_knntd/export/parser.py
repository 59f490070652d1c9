"""The command ``sb3-knntd export``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_knntd.common.command_line import CommandError, reason_of
from sb3_knntd.export import FORMATS
from sb3_knntd.export.c99 import PRECISIONS
from sb3_knntd.export.frozen import ROWS
from sb3_knntd.registry import for_saved

if TYPE_CHECKING:
    from sb3_knntd.common.command_line import Subparsers


def add_export(subparsers: Subparsers) -> None:
    """
    :param subparsers: where to add the command
    """
    listed = "; ".join(f"{name}: {kind.description}" for name, kind in FORMATS.items())
    parser = subparsers.add_parser(
        "export",
        help="write a learned policy as C, ONNX, TorchScript, safetensors, CSV or NPZ",
        description="Write the greedy policy of a saved model in a form that does not need this package.",
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="file of a saved model")
    parser.add_argument("--format", required=True, choices=FORMATS, metavar="FORMAT", help=listed)
    parser.add_argument("--out", required=True, type=Path, metavar="FILE", help="file to write")
    parser.add_argument(
        "--test-vectors",
        type=Path,
        metavar="FILE",
        help="file for random observations with their actions and values, CSV, to test the exported policy with",
    )
    parser.add_argument("--precision", choices=PRECISIONS, help="of format c (default: double)")
    parser.add_argument(
        "--rows",
        choices=ROWS,
        help="rows of the table to store, of format c: those that differ from the initial value, all, or what takes "
        "less memory (default: auto)",
    )
    parser.add_argument(
        "--trusted",
        action="store_true",
        help="unpickle objects in the model's file, which executes code from it; needed if it holds functions",
    )
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    options = {name: getattr(args, name) for name in ("precision", "rows") if getattr(args, name) is not None}
    try:
        model = for_saved(args.model).load().load(args.model, trusted=args.trusted)
        written = model.policy.export(args.out, args.format, test_vectors=args.test_vectors, **options)
    except (ValueError, OSError, ImportError) as error:
        raise CommandError(reason_of(error).replace("trusted=True", "--trusted")) from error
    for path in written:
        print(f"{path} ({path.stat().st_size:,} bytes)")
    return 0
