"""The bundle: two networks and everything they assume, in one folder that is verified before it is used.

`planner.onnx`, `skill.onnx`, `golden.npz` (inputs with the outputs they must give) and `manifest.json`. The bytes that
were hashed are the bytes that are handed out; nothing is read twice and nothing is unpickled.
"""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from hiernav.files import write_atomically
from hiernav.nav.observation import ObservationLayout, ObservationTerm
from hiernav.nav.onnx_file import OnnxFacts, OnnxFileError, inspect_onnx
from hiernav.nav.termination import ReplanRule

FORMAT_VERSION = 1
"""Of the manifest. An older runtime refuses a field that it does not know; raise it where one changes its meaning."""
PLANNER, SKILL, GOLDEN, MANIFEST = "planner.onnx", "skill.onnx", "golden.npz", "manifest.json"
HASHED_FILES = (PLANNER, SKILL, GOLDEN)
MAX_FILE_BYTES = 50_000_000
MAX_MANIFEST_BYTES = 1_000_000
GOLDEN_NAMES = ("observation", "action", "image", "distance", "waypoints", "scores")
"""Arrays of `golden.npz`: skill input and output, planner inputs and outputs; float32, and uint8 the image."""
_GOLDEN_RANKS = {"observation": 2, "action": 2, "image": 4, "distance": 1, "waypoints": 4, "scores": 2}

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
# Bounds far beyond any robot, below which nothing overflows and no array takes the memory.
Size = Annotated[int, msgspec.Meta(ge=1, le=10_000)]
Seconds = Annotated[float, msgspec.Meta(ge=1e-4, le=100.0)]
Length = Annotated[float, msgspec.Meta(ge=1e-4, le=1000.0)]
Margin = Annotated[float, msgspec.Meta(ge=0.0, le=1000.0)]
Sha256 = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class BundleError(ValueError):
    """A bundle that must not be used; the message names what does not fit."""


class _Struct(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class TensorSpec(_Struct, frozen=True):
    """An input or output of a network."""

    name: str
    shape: tuple[int | None, ...]
    """None is the batch."""
    dtype: str


class SkillSpec(_Struct, frozen=True):
    """The skill network: observations to actions."""

    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]


class PlannerSpec(_Struct, frozen=True):
    """The planner network: GOSELO images and distances to waypoints and scores."""

    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]
    preset: str
    channels: Size


class ObservationField(_Struct, frozen=True):
    """One term of the observation, as `ObservationTerm`."""

    name: str
    size: Size
    unit: str
    scale: float


class GoseloSpec(_Struct, frozen=True):
    """How the planner's images are made; defaults are those of bundles that do not say all of it."""

    pixels: Size
    channels: tuple[str, ...]
    local_side_m: Length
    margin_m: Margin = 0.4
    min_distance_m: Length = 0.1
    clearance_clip_m: Length = 0.64
    visit_clip: Size = 4


class PlanSpec(_Struct, frozen=True):
    """What a plan looks like."""

    waypoints: Annotated[int, msgspec.Meta(ge=2, le=100)]
    """As `option.waypoints` of a training."""
    spacing_m: Length
    planning_radius_m: Length
    """Disc that must fit on a plan."""
    soft_margin_m: Margin
    """Further clearance worth a detour when a plan is repaired."""


class ReplanSpec(_Struct, frozen=True):
    """Thresholds of the rule that ends an option, named as in `OptionConfig`.

    In training, in an evaluation and on the robot they act through `rule` alone.
    """

    d_update_m: Positive
    half_fraction: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
    invalid: bool
    period: Count | None = None

    def rule(self) -> ReplanRule:
        """The rule of these thresholds."""
        return ReplanRule(
            d_update=self.d_update_m, half_fraction=self.half_fraction, invalid=self.invalid, period=self.period
        )


class GuardSpec(_Struct, frozen=True):
    """What the guard must do so that the skill drives as it was trained."""

    slew_limit: Positive | None = None


class Manifest(_Struct, frozen=True, kw_only=True):
    """Everything the networks assume."""

    format_version: int = FORMAT_VERSION
    robot: str
    robot_sha256: Sha256
    """Of the robot's model file."""
    control_period_s: Seconds
    map_resolution_m: Length
    files: dict[str, Sha256] = {}
    """Filled in by `write_manifest`."""
    opset: int = 0
    """Filled in by `write_manifest`."""
    planner: PlannerSpec
    skill: SkillSpec
    observation: tuple[ObservationField, ...]
    goselo: GoseloSpec
    plan: PlanSpec
    replan: ReplanSpec
    guard: GuardSpec = GuardSpec()
    provenance: dict[str, str | int | float] = {}
    """Where the networks come from; for people."""


@dataclass(frozen=True)
class Bundle:
    """A verified bundle in memory."""

    manifest: Manifest
    planner: bytes
    """Serialised ONNX model."""
    skill: bytes
    """Serialised ONNX model."""
    golden: Mapping[str, np.ndarray]
    """observation (N, D), action (N, A), image (M, C, 64, 64) uint8, distance (M,) [m], waypoints (M, H, K, 2) [m] and
    scores (M, H); float32."""

    @property
    def layout(self) -> ObservationLayout:
        """The observation the skill was trained on."""
        fields = self.manifest.observation
        return ObservationLayout(tuple(ObservationTerm(f.name, f.size, f.unit, f.scale) for f in fields))

    def require_robot(self, name: str, sha256: str) -> None:
        """Raise BundleError unless the bundle was made for this robot and this very model file of it."""
        if name != self.manifest.robot:
            raise BundleError(f"robot: the bundle is for {self.manifest.robot!r}, this is {name!r}")
        if sha256 != self.manifest.robot_sha256:
            raise BundleError(
                f"robot_sha256: the model of {name!r} has changed since training "
                f"({self.manifest.robot_sha256[:12]} in the bundle, {sha256[:12]} here)"
            )

    def require_period(self, period: float) -> None:
        """Raise BundleError unless the robot is driven at the rate that the skill was trained at; `period` in [s]."""
        theirs = self.manifest.control_period_s
        if not abs(period - theirs) <= 1e-6:
            raise BundleError(f"control_period_s: {theirs:g} s in the bundle, {period:g} s on this robot")

    def require_actions(self, count: int) -> None:
        """Raise BundleError unless the robot has as many actuators as the skill commands."""
        theirs = self.golden["action"].shape[1]
        if count != theirs:
            raise BundleError(f"actions: {theirs} in the bundle, {count} on this robot")

    def require_resolution(self, resolution: float) -> None:
        """Raise BundleError unless maps are of the resolution that the planner was trained with; in [m]."""
        theirs = self.manifest.map_resolution_m
        if not abs(resolution - theirs) <= 1e-9:
            raise BundleError(f"map_resolution_m: {theirs:g} m in the bundle, {resolution:g} m in the runtime")

    def require_layout(self, layout: ObservationLayout) -> None:
        """Raise BundleError naming the first field in which the robot's observation differs from the bundle's."""
        ours, theirs = layout.terms, self.layout.terms
        for index, (here, there) in enumerate(zip(ours, theirs, strict=False)):
            for key in ("name", "size", "unit", "scale"):
                if getattr(here, key) != getattr(there, key):
                    raise BundleError(
                        f"observation[{index}] {there.name!r}: {key} is {getattr(there, key)!r} in the bundle, "
                        f"{getattr(here, key)!r} on this robot"
                    )
        if len(ours) != len(theirs):
            longer, where = (ours, "on this robot") if len(ours) > len(theirs) else (theirs, "in the bundle")
            index = min(len(ours), len(theirs))
            raise BundleError(f"observation[{index}] {longer[index].name!r}: it exists only {where}")


def write_golden(folder: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write `golden.npz`; ValueError unless `arrays` has exactly the `GOLDEN_NAMES`."""
    if set(arrays) != set(GOLDEN_NAMES):
        raise ValueError(f"golden arrays are {', '.join(sorted(arrays))}; they must be {', '.join(GOLDEN_NAMES)}")
    plain: dict[str, Any] = {name: np.asarray(array) for name, array in arrays.items()}
    np.savez_compressed(folder / GOLDEN, **plain)


def write_manifest(folder: Path, manifest: Manifest) -> Manifest:
    """Write `manifest.json` last, over the files that are already in `folder`.

    Returns:
        The manifest with hashes and opset filled in.

    Raises:
        BundleError: the folder would not make a bundle that can be loaded.
    """
    contents = {name: _read(folder, name, MAX_FILE_BYTES) for name in HASHED_FILES}
    opsets = {name: _check_model(contents[name], name).opset for name in (PLANNER, SKILL)}
    if len(set(opsets.values())) != 1:
        raise BundleError(f"opset: {', '.join(f'{name} has {opset}' for name, opset in opsets.items())}")
    _decode_golden(contents[GOLDEN])
    files = {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()}
    manifest = msgspec.structs.replace(manifest, files=files, opset=opsets[SKILL])
    encoded = msgspec.json.format(msgspec.json.encode(manifest), indent=2)
    _decode_manifest(encoded)
    write_atomically(folder / MANIFEST, encoded + b"\n")
    return manifest


def load_bundle(path: str | Path) -> Bundle:
    """Read and verify a bundle.

    Raises:
        BundleError: a file is missing, too large or altered, the manifest is malformed or made by a newer version, a
            model has external data or custom operators, or the golden arrays are damaged or of other types or ranks.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise BundleError(f"{folder}: no such folder")
    manifest = _decode_manifest(_read(folder, MANIFEST, MAX_MANIFEST_BYTES))
    contents: dict[str, bytes] = {}
    for name in HASHED_FILES:
        contents[name] = data = _read(folder, name, MAX_FILE_BYTES)
        if hashlib.sha256(data).hexdigest() != manifest.files[name]:
            raise BundleError(f"{name}: SHA-256 differs from the manifest; the file is truncated or altered")
    for name in (PLANNER, SKILL):
        opset = _check_model(contents[name], name).opset
        if opset != manifest.opset:
            raise BundleError(f"{name}: opset {opset}, the manifest says {manifest.opset}")
    return Bundle(manifest, contents[PLANNER], contents[SKILL], _decode_golden(contents[GOLDEN]))


def is_bundle(path: str | Path) -> bool:
    """Whether a folder holds the files of a bundle, whole or damaged and of any version, and nothing else."""
    folder = Path(path)
    if not folder.is_dir() or any(
        entry.name not in (*HASHED_FILES, MANIFEST) or not entry.is_file() for entry in folder.iterdir()
    ):
        return False
    try:
        msgspec.json.decode(_read(folder, MANIFEST, MAX_MANIFEST_BYTES), type=_Version)
    except (BundleError, msgspec.DecodeError, UnicodeDecodeError):
        return False
    return True


def file_sha256(path: str | Path) -> str:
    """SHA-256 of a file, as the manifest keeps it for the robot's model."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


class _Version(msgspec.Struct):
    format_version: int


def _decode_manifest(data: bytes) -> Manifest:
    try:
        # First and leniently: what a newer format looks like beyond this field cannot be known here.
        version = msgspec.json.decode(data, type=_Version).format_version
        if version > FORMAT_VERSION:
            raise BundleError(
                f"{MANIFEST}: format_version {version} was made by a newer hiernav (this one reads {FORMAT_VERSION}): "
                "upgrade hiernav"
            )
        if version < 1:
            raise BundleError(f"{MANIFEST}: format_version {version}, the first one is 1")
        manifest = msgspec.json.decode(data, type=Manifest)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise BundleError(f"{MANIFEST}: {error}") from None
    if set(manifest.files) != set(HASHED_FILES):
        raise BundleError(
            f"{MANIFEST}: files lists {', '.join(sorted(map(repr, manifest.files))) or 'nothing'}; "
            f"it must list exactly {', '.join(HASHED_FILES)}"
        )
    return manifest


def _read(folder: Path, name: str, limit: int) -> bytes:
    path = folder / name
    if not path.is_file():
        raise BundleError(f"{name}: missing in {folder}")
    with path.open("rb") as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise BundleError(f"{name}: larger than {limit / 1e6:g} MB")
    return data


def _check_model(data: bytes, name: str) -> OnnxFacts:
    try:
        facts = inspect_onnx(data)
    except OnnxFileError as error:
        raise BundleError(f"{name}: not an ONNX model: {error}") from None
    if facts.external_data:
        raise BundleError(f"{name}: weights in external files are not accepted")
    if facts.custom_operators:
        raise BundleError(f"{name}: custom operators are not accepted: {', '.join(facts.custom_operators)}")
    return facts


def _decode_golden(data: bytes) -> dict[str, np.ndarray]:
    try:
        golden = _read_arrays(data)
    except BundleError:
        raise
    except Exception as error:  # zipfile, zlib and numpy's headers fail in any of a dozen ways
        reason = " ".join(str(error).split())[:200]
        raise BundleError(f"{GOLDEN}: damaged ({reason or type(error).__name__})") from None
    for names in (("observation", "action"), ("image", "distance", "waypoints", "scores")):
        rows = [len(golden[name]) for name in names]
        if len(set(rows)) != 1:
            raise BundleError(f"{GOLDEN}: {', '.join(names)} have {', '.join(map(str, rows))} rows, expected as many")
    return golden


def _read_arrays(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of a golden file; memory is taken only for bytes that are there."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
        if sum(entry.file_size for entry in entries) > MAX_FILE_BYTES:
            raise BundleError(f"{GOLDEN}: inflates to more than {MAX_FILE_BYTES / 1e6:g} MB")
        names = sorted(entry.filename for entry in entries)
        if names != sorted(f"{name}.npy" for name in GOLDEN_NAMES):
            shown = ", ".join(name.removesuffix(".npy") for name in names[: 2 * len(GOLDEN_NAMES)])
            raise BundleError(f"{GOLDEN}: holds {shown}; it must hold {', '.join(GOLDEN_NAMES)}")
        arrays, left = {}, MAX_FILE_BYTES
        for name in GOLDEN_NAMES:
            entry = archive.getinfo(f"{name}.npy")
            # others are inflated without a limit
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise BundleError(f"{GOLDEN}: {name} is compressed by method {entry.compress_type}, expected deflate")
            with archive.open(entry) as member:
                array = member.read(left + 1)
            left -= len(array)
            if left < 0:
                raise BundleError(f"{GOLDEN}: inflates to more than {MAX_FILE_BYTES / 1e6:g} MB")
            arrays[name] = _read_array(name, array)
    return arrays


def _read_array(name: str, data: bytes) -> np.ndarray:
    """An array of the golden file, whose header must be that of `GOLDEN_NAMES` and fit the bytes after it."""
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise BundleError(f"{GOLDEN}: {name} is of npy version {version}, expected 1.0 or 2.0")
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran_order, dtype = read_header(file)
    expected, rank = np.dtype(np.uint8 if name == "image" else np.float32), _GOLDEN_RANKS[name]
    if dtype != expected:
        raise BundleError(f"{GOLDEN}: {name} is {str(dtype)[:40]}, expected {expected}")
    if len(shape) != rank or min(shape) < 1:
        raise BundleError(f"{GOLDEN}: {name} has shape {str(shape)[:80]}, expected {rank} axes, none of them empty")
    body = data[file.tell() :]
    if math.prod(shape) * expected.itemsize != len(body):
        raise BundleError(f"{GOLDEN}: {name} has shape {str(shape)[:80]}, which {len(body)} bytes do not fill")
    return np.frombuffer(body, expected).reshape(shape, order="F" if fortran_order else "C").copy()
