"""Loading of the scene in a verb's flags."""

from __future__ import annotations

import argparse

import mitsuba as mi

from mivol.errors import MivolError
from mivol.experiments.back_end import choose_back_end
from mivol.scene.load import LoadedScene, load_scene


def load(arguments: argparse.Namespace) -> LoadedScene:
    """Load the scene of the flags, with variant and threads.

    Raises:
        MivolError: an unknown variant, a define without "=", or an invalid scene.
    """
    choose_back_end(arguments.mode, arguments.threads)
    mi.set_log_level(mi.LogLevel.Debug if arguments.verbose else mi.LogLevel.Warn)
    for folder in filter(None, arguments.a.split(";")):
        mi.file_resolver().append(folder)
    return load_scene(arguments.scene, defines(arguments.define))


def defines(pairs: list[str]) -> dict[str, str]:
    """Convert ``name=value`` pairs to a dict.

    Raises:
        MivolError: a pair without "=".
    """
    wrong = next((pair for pair in pairs if "=" not in pair), None)
    if wrong is not None:
        raise MivolError(f'-D "{wrong}" defines nothing: write -D name=value.')
    return dict(pair.split("=", 1) for pair in pairs)
