"""Ground: flat, steps, rough, soft, and rough with holes.

Heights are drawn from a seed on a square of ``size_m``; the outermost metre is there so that a
robot kept inside by its controller never sees the rim.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, get_args

import mujoco
import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact_sim.limits import check_number, check_word

TerrainKind = Literal["flat", "steps", "rough", "soft", "holes"]

# Hard ground: a contact settles in 4 ms, twice the shortest the 1 ms step allows twice over.
HARD_SOLREF: Final = (0.004, 1.0)
# Grid of the rough field.  Contacts with a height field cost by the cell they cover: 4 cm is
# wider than a foot, and finer detail than that is the foot's own shape.
_CELL_M: Final = 0.04
_TILE_M: Final = 0.2
_BASE_M: Final = 0.2
# Holes in the rough field: so many cells wide, and deeper than a descent aims below the ground that
# it expects.  None lie near the middle, where a robot begins.
_HOLE_CELLS: Final = 3


@dataclass(frozen=True)
class TerrainSettings:
    """What the ground is."""

    # `flat`; `steps` (square tiles at random heights); `rough` (height field); `soft` (flat
    # and yielding); `holes` (rough, with square holes at random places, in which a descent finds
    # no ground)
    kind: TerrainKind = "rough"
    relief_m: float = 0.035  # from the lowest to the highest point
    size_m: float = 6.0  # edge of the square
    stiffness_n_m: float = 1000.0  # of soft ground, per contact point
    holes: float = 0.03  # share of the ground that lies in one, of `holes`
    seed: int | None = None  # of the heights; None for the run's

    def __post_init__(self) -> None:
        check_word("terrain", self.kind, get_args(TerrainKind))
        check_number("terrain relief", self.relief_m, 0.0, 0.08, "m")  # legs lift about 5 cm
        check_number("share of holes", self.holes, 0.0, 0.5)
        check_number("ground stiffness", self.stiffness_n_m, 100.0, 100_000.0, "N/m")


class Terrain:
    """Heights of one ground, and its geoms."""

    def __init__(self, settings: TerrainSettings) -> None:
        self.settings = settings
        rng = np.random.default_rng([settings.seed or 0, 0x7E44A])
        pitch_m = _TILE_M if settings.kind == "steps" else _CELL_M
        self._cells = max(2, round(settings.size_m / pitch_m))
        if settings.kind in ("rough", "holes"):
            self._heights = _rough(self._cells, settings.relief_m, rng)
            if settings.kind == "holes":
                self._heights -= 0.1 * _holes(self._cells, settings.holes, rng)
        elif settings.kind == "steps":
            self._heights = rng.uniform(0.0, settings.relief_m, (self._cells, self._cells))
        else:
            self._heights = np.zeros((2, 2))

    @property
    def surface(self) -> Literal["hard", "soft"]:
        """What a touch of it counts as."""
        return "soft" if self.settings.kind == "soft" else "hard"

    def height_at(self, x_m: Array, y_m: Array) -> Array:
        """Height of the ground, m; bilinear on the rough field (the engine's is triangulated)."""
        if self.settings.kind in ("flat", "soft"):
            return np.zeros(np.broadcast(x_m, y_m).shape)
        n = self._cells
        half = self.settings.size_m / 2
        if self.settings.kind == "steps":
            i = np.clip(np.floor((np.asarray(x_m) + half) / _TILE_M), 0, n - 1).astype(int)
            j = np.clip(np.floor((np.asarray(y_m) + half) / _TILE_M), 0, n - 1).astype(int)
            return np.asarray(self._heights[j, i])
        u = np.clip((np.asarray(x_m) + half) / (2 * half) * (n - 1), 0, n - 1.001)
        v = np.clip((np.asarray(y_m) + half) / (2 * half) * (n - 1), 0, n - 1.001)
        i, j = u.astype(int), v.astype(int)
        a, b = u - i, v - j
        h = self._heights
        return np.asarray(
            (1 - a) * (1 - b) * h[j, i]
            + a * (1 - b) * h[j, i + 1]
            + (1 - a) * b * h[j + 1, i]
            + a * b * h[j + 1, i + 1]
        )

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the ground's geoms, named ``ground`` or ``ground_{i}_{j}``, to a model."""
        settings = self.settings
        common = {
            "contype": 0,
            "conaffinity": 1,
            # The ground's own contact parameters hold, whatever touches it.
            "priority": 1,
            "friction": [0.9, 0.005, 0.0001],
            "solref": list(HARD_SOLREF),
            "material": "ground",
        }
        world = spec.worldbody
        half = settings.size_m / 2
        if settings.kind in ("rough", "holes"):
            low, high = float(self._heights.min()), float(self._heights.max())
            n = self._cells
            spec.add_hfield(
                name="ground",
                size=[half, half, max(high - low, 1e-6), _BASE_M],
                nrow=n,
                ncol=n,
                userdata=((self._heights - low) / max(high - low, 1e-6)).ravel().tolist(),
            )
            world.add_geom(
                name="ground",
                type=mujoco.mjtGeom.mjGEOM_HFIELD,
                hfieldname="ground",
                pos=[0.0, 0.0, low],
                **common,
            )
        elif settings.kind == "steps":
            for j in range(self._cells):
                for i in range(self._cells):
                    edge = (self._heights[j, i] + _BASE_M) / 2
                    world.add_geom(
                        name=f"ground_{i}_{j}",
                        type=mujoco.mjtGeom.mjGEOM_BOX,
                        size=[_TILE_M / 2, _TILE_M / 2, edge],
                        pos=[
                            (i + 0.5) * _TILE_M - half,
                            (j + 0.5) * _TILE_M - half,
                            edge - _BASE_M,
                        ],
                        **common,
                    )
        else:
            world.add_geom(
                name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[half, half, 0.1], **common
            )

    def set_stiffness(self, model: mujoco.MjModel, foot: str = "lf_foot") -> None:
        """Set the stiffness of soft ground under such a foot; it needs the compiled model."""
        if self.settings.kind == "soft":
            geom = model.geom("ground").id
            foot_body = int(model.geom_bodyid[model.geom(foot).id])
            solref, solimp = soft_contact(
                self.settings.stiffness_n_m, float(model.body_invweight0[foot_body, 0])
            )
            model.geom_solref[geom] = solref
            model.geom_solimp[geom] = solimp


def soft_contact(stiffness_n_m: float, inverse_mass: float) -> tuple[Array, Array]:
    r"""Contact parameters of a spring of given stiffness, damped at half of what is critical.

    With impedance :math:`d` the engine regularises a contact by :math:`R = (1-d)/d\,A`, where
    :math:`A` is the touching body's inverse mass; at rest the force is :math:`k r / R` for
    penetration :math:`r` and the reference stiffness :math:`k`, so :math:`k = K R`.

    Args:
        stiffness_n_m: wanted, N/m.
        inverse_mass: ``body_invweight0`` (translation) of the touching body, 1/kg.

    Returns:
        ``solref`` (2,) in the direct format, ``solimp`` (5,).

    Reference:
        MuJoCo documentation, *Solver parameters*: direct format of ``solref``,
        :math:`k = -\text{solref}_0\, d / d_{max}^2`.
    """
    # Impedance: low enough that the contact's own compliance dominates.
    d = damping_ratio = 0.5
    regularisation = (1.0 - d) / d * inverse_mass
    k = stiffness_n_m * regularisation
    damping = 2.0 * damping_ratio * math.sqrt(stiffness_n_m / inverse_mass) * regularisation
    solref = np.array([-k * d, -damping * d])
    solimp = np.array([d, d, 0.001, 0.5, 2.0])
    return solref, solimp


def _rough(cells: int, relief_m: float, rng: np.random.Generator) -> Array:
    """Smooth hills of 20-40 cm with stones of a cell or two on them."""
    hills = _smooth(rng.standard_normal((cells, cells)), 4.0)
    stones = _smooth(rng.standard_normal((cells, cells)), 1.0)
    heights = hills / hills.std() + 0.5 * stones / stones.std()
    # Clip the tails: relief is a promise to the gait, and a normal field has no largest value.
    heights = np.clip(heights / heights.std(), -2.0, 2.0)
    return np.asarray((heights + 2.0) / 4.0 * relief_m)


def _holes(cells: int, share: float, rng: np.random.Generator) -> Mask:
    """(cells, cells) which points of a field lie in a hole; squares, up to the share."""
    sunk = np.zeros((cells, cells), dtype=np.bool_)
    middle = np.hypot(*np.meshgrid(*2 * [(np.arange(cells) - cells / 2) * _CELL_M]))
    while sunk.mean() < share:
        i, j = rng.integers(0, cells - _HOLE_CELLS, 2)
        sunk[j : j + _HOLE_CELLS, i : i + _HOLE_CELLS] = True
        sunk &= middle > 0.4
    return sunk


def _smooth(field: Array, width_cells: float) -> Array:
    """Gaussian blur by convolution with itself along both axes, edges wrapped."""
    n = field.shape[0]
    frequency = np.fft.fftfreq(n)
    gain = np.exp(-2.0 * (np.pi * width_cells * frequency) ** 2)
    return np.asarray(np.fft.ifft2(np.fft.fft2(field) * gain[:, None] * gain[None, :]).real)
