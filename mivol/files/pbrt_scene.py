"""Scenes of pbrt-v4 (``.pbrt``): directives with their parameters and the current graphics state.

Own reader: no package on PyPI reads scenes of pbrt-v4.

Conventions. A transform maps from the space of an object to the world, as columns; before ``WorldBegin`` it maps from the world
to the camera. Lists of numbers are float64 arrays. Included files are read from the folder of the file that names them.

Reference: pbrt-v4 File Format (pbrt.org/fileformat-v4); Pharr, Jakob, Humphreys, "Physically Based Rendering", 4th edition.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np

from mivol.files.source import decompress, read_bytes, refusal

TOKEN = re.compile(r'\s*(?:"([^"]*)"|(\[)|(\])|([A-Za-z_][\w]*)|([^\s"\[\]]+))')
END = re.compile(r"\s*\Z")
COMMENT = re.compile(r'("[^"\n]*")|#[^\n]*')

DEEPEST = 16
"""Files that include each other."""

LONGEST = 1 << 30
"""Largest text in a compressed file [bytes]."""

#: directive -> numbers that follow it, in brackets or not.
NUMBERS = {"Translate": 3, "Scale": 3, "Rotate": 4, "LookAt": 9, "Transform": 16, "ConcatTransform": 16}

#: directives with a type in quotes and parameters.
TYPED = (
    *("Camera", "Film", "Sampler", "Integrator", "PixelFilter", "Accelerator", "ColorSpace"),
    *("Shape", "Material", "MakeNamedMaterial", "NamedMaterial", "MakeNamedMedium", "LightSource", "AreaLightSource"),
    *("Attribute", "CoordinateSystem", "CoordSysTransform", "ObjectBegin", "ObjectInstance", "Include", "Import"),
)


@dataclasses.dataclass(frozen=True)
class State:
    """The graphics state of a directive.

    Attributes:
        transform: object to world (4, 4).
        material: type and parameters of the material; empty type for none.
        area_light: parameters of the area light; None without one.
        medium: names of the media inside and outside.
    """

    transform: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))
    material: tuple[str, dict[str, Any]] = ("diffuse", {})
    area_light: dict[str, Any] | None = None
    medium: tuple[str, str] = ("", "")


@dataclasses.dataclass(frozen=True)
class Directive:
    """A directive of a scene: its name, its type, its parameters by name (without their types), and the state."""

    name: str
    type: str
    parameters: dict[str, Any]
    state: State

    def number(self, name: str, default: float) -> float:
        """A number among the parameters."""
        value = self.parameters.get(name, default)
        return float(np.ravel(value)[0]) if np.size(value) else default

    def numbers(self, name: str) -> np.ndarray | None:
        """A list of numbers among the parameters; None without it."""
        value = self.parameters.get(name)
        return None if value is None else np.ravel(np.asarray(value, np.float64))

    def text(self, name: str, default: str = "") -> str:
        """A text among the parameters."""
        value = self.parameters.get(name, default)
        return value if isinstance(value, str) else default


def read_pbrt_scene(path: Path) -> tuple[list[Directive], list[str]]:
    """Read the directives of a scene.

    Returns:
        Directives in the order of the file, and names of what the reader leaves out.

    Raises:
        MivolError: a missing or damaged file, an unknown directive, or a wrong number of numbers.
    """
    reader = _Reader()
    reader.read(path)
    return reader.directives, list(dict.fromkeys(reader.left_out))


class _Reader:
    """State of a file that is read."""

    def __init__(self) -> None:
        self.directives: list[Directive] = []
        self.left_out: list[str] = []
        self.state, self.saved, self.depth = State(), [], 0
        self.named: dict[str, tuple[str, dict[str, Any]]] = {}
        self.systems: dict[str, np.ndarray] = {}
        self.objects = 0

    def read(self, path: Path) -> None:
        """Read a file and its included files."""
        self.depth += 1
        if self.depth > DEEPEST:
            raise refusal(path, f"more than {DEEPEST} files within each other", "fewer", "correct the Include directives")
        data = read_bytes(path)
        if data[:2] == b"\x1f\x8b":
            data = decompress(data, "gzip", LONGEST, path)
        tokens = _Tokens(COMMENT.sub(lambda m: m[1] or "", data.decode("utf-8", "replace")), path)
        while (name := tokens.word()) is not None:
            self.take(name, tokens, path)
        self.depth -= 1

    def take(self, name: str, tokens: _Tokens, path: Path) -> None:
        """Take one directive."""
        if name in NUMBERS:
            self.move(_matrix(name, tokens.numbers(NUMBERS[name], name)), name == "Transform")
        elif name == "Identity":
            self.move(np.eye(4), True)
        elif name in ("AttributeBegin", "TransformBegin"):
            self.saved.append(self.state)
        elif name in ("AttributeEnd", "TransformEnd"):
            if not self.saved:
                raise refusal(path, f"{name} without a beginning", "pairs", "correct the scene")
            before = self.saved.pop()
            self.state = before if name == "AttributeEnd" else dataclasses.replace(self.state, transform=before.transform)
        elif name == "WorldBegin":
            self.systems["camera"], self.state = (
                np.linalg.inv(self.state.transform),
                dataclasses.replace(self.state, transform=np.eye(4)),
            )
        elif name == "MediumInterface":
            inside = tokens.quoted(name)
            outside = tokens.quoted(name) if tokens.next_is_quoted() else inside
            self.state = dataclasses.replace(self.state, medium=(inside, outside))
        elif name == "Texture":
            self.left_out.append(f"the texture {tokens.quoted(name)!r}")
            tokens.quoted(name), tokens.quoted(name), tokens.parameters()
        elif name in TYPED:
            self.take_typed(name, tokens.quoted(name), tokens, path)
        elif name == "ObjectEnd" and self.objects:
            self.objects -= 1
            self.state = self.saved.pop()
        elif name == "Option":
            self.left_out += [f"the option {option!r}" for option in tokens.parameters()]
        elif name != "ReverseOrientation":
            raise refusal(
                path, f"the directive {name!r}", f"one of {', '.join((*NUMBERS, *TYPED))}", "is this a scene of pbrt-v4?"
            )

    def take_typed(self, name: str, kind: str, tokens: _Tokens, path: Path) -> None:
        """Take a directive with a type."""
        parameters = tokens.parameters()
        state = self.state
        if name in ("Include", "Import"):
            self.read(path.parent / kind)
        elif name == "Material":
            self.state = dataclasses.replace(state, material=(kind, parameters))
        elif name == "MakeNamedMaterial":
            self.named[kind] = (str(parameters.get("type", "diffuse")), parameters)
        elif name == "NamedMaterial":
            self.state = dataclasses.replace(state, material=self.named.get(kind, ("diffuse", {})))
        elif name == "AreaLightSource":
            self.state = dataclasses.replace(state, area_light=parameters)
        elif name == "CoordinateSystem":
            self.systems[kind] = state.transform
        elif name == "CoordSysTransform":
            self.state = dataclasses.replace(state, transform=self.systems.get(kind, state.transform))
        elif name in ("ObjectBegin", "ObjectInstance"):
            if name == "ObjectBegin":
                self.objects += 1
                self.saved.append(state)
            self.left_out.append("instances of objects")
        elif name in ("PixelFilter", "Accelerator", "ColorSpace", "Attribute"):
            self.left_out.append(f"{name} {kind!r}")
        elif not self.objects:
            self.directives.append(Directive(name, kind, parameters, state))

    def move(self, matrix: np.ndarray, replaces: bool) -> None:
        """Multiply or replace the transform."""
        self.state = dataclasses.replace(self.state, transform=matrix if replaces else self.state.transform @ matrix)


class _Tokens:
    """The words, texts and numbers of a file."""

    def __init__(self, text: str, path: Path) -> None:
        self.text_, self.path, self.at = text, path, 0

    def _next(self) -> re.Match | None:
        return TOKEN.match(self.text_, self.at)

    def _refuse(self, expected: str) -> Exception:
        line = self.text_.count("\n", 0, self.at) + 1
        found = self.text_[self.at : self.at + 30].strip() or "the end of the file"
        return refusal(self.path, f"{found!r} in line {line}", expected, "is this a scene of pbrt-v4?")

    def word(self) -> str | None:
        """The next directive; None at the end."""
        if END.match(self.text_, self.at):
            return None
        match = self._next()
        if match is None or match[4] is None:
            raise self._refuse("a directive")
        self.at = match.end()
        return match[4]

    def next_is_quoted(self) -> bool:
        """Whether a text in quotes follows."""
        match = self._next()
        return match is not None and match[1] is not None

    def quoted(self, directive: str) -> str:
        """A text in quotes."""
        match = self._next()
        if match is None or match[1] is None:
            raise self._refuse(f"a text in quotes after {directive}")
        self.at = match.end()
        return match[1]

    def numbers(self, count: int, directive: str) -> np.ndarray:
        """Numbers in brackets or without them."""
        words, match = [], self._next()
        brackets = match is not None and match[2] is not None
        while match is not None and len(words) < count + 2 * brackets:
            words.append(match.group().strip())
            self.at = match.end()
            match = self._next()
        try:
            found = np.array(words[1:-1] if brackets else words, np.float64)
        except ValueError:
            found = np.zeros(0)
        if len(found) != count or not np.isfinite(found).all():
            raise self._refuse(f"{count} numbers after {directive}")
        return found

    def parameters(self) -> dict[str, Any]:
        """Parameters by name: texts, truth values, and arrays of numbers; a spectrum or a texture by name is a text."""
        found: dict[str, Any] = {}
        while self.next_is_quoted():
            words = self.quoted("").split()
            if len(words) != 2:
                raise self._refuse("a type and a name in quotes")
            found[words[1]] = self._value()
            if words[0] == "blackbody":
                found[words[1]] = {"blackbody": found[words[1]]}
            elif words[0] == "spectrum" and not isinstance(found[words[1]], str):
                found[words[1]] = {"spectrum": found[words[1]]}
        return found

    def _value(self) -> Any:
        match = self._next()
        if match is None:
            raise self._refuse("a value")
        if match[2] is None:
            self.at = match.end()
            return match[1] if match[1] is not None else self._parse(match.group())
        end = self.text_.find("]", match.end())
        if end < 0:
            raise self._refuse("a closing bracket")
        inside, self.at = self.text_[match.end() : end], end + 1
        if '"' in inside:
            texts = re.findall(r'"([^"]*)"', inside)
            return texts[0] if len(texts) == 1 else texts
        return self._parse(inside)

    def _parse(self, text: str) -> Any:
        words = text.split()
        if words and words[0] in ("true", "false"):
            return words[0] == "true"
        try:
            return np.array(words, np.float64)
        except ValueError:
            raise self._refuse("numbers") from None


def _matrix(name: str, numbers: np.ndarray) -> np.ndarray:
    """The matrix (4, 4) of a transform."""
    matrix = np.eye(4)
    if name == "Translate":
        matrix[:3, 3] = numbers
    elif name == "Scale":
        matrix[:3, :3] = np.diag(numbers)
    elif name == "Rotate":
        angle, axis = np.deg2rad(numbers[0]), numbers[1:] / max(np.linalg.norm(numbers[1:]), 1e-300)
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        matrix[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    elif name == "LookAt":
        eye, target, up = numbers.reshape(3, 3)
        forward = (target - eye) / max(np.linalg.norm(target - eye), 1e-300)
        right = np.cross(up, forward)
        right /= max(np.linalg.norm(right), 1e-300)
        columns = np.eye(4)
        columns[:3] = np.column_stack([right, np.cross(forward, right), forward, eye])
        if abs(np.linalg.det(columns)) < 1e-12:
            columns = np.eye(4)
        matrix = np.linalg.inv(columns)
    else:
        matrix = numbers.reshape(4, 4).T
    return matrix
