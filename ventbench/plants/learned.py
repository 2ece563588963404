"""The paper's stitched network as a plant: windows of past pressures and controls to the next."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from ventbench.task import protocol
from ventbench.task.interfaces import Signals

#: Interval at which the network's rate output is an increment, s (mean of the recordings').
REFERENCE_DT = 0.033

#: Pressures that a learned plant can reach, cmH2O: it bends towards them within 1 cmH2O and is
#: exact (to float32) between 15 cmH2O above the lower and 15 below the upper one.
LOWEST, HIGHEST = -15.0, 100.0

#: Activations by name: the paper's SELU, and tanh, which is smooth and bounded.
ACTIVATIONS = {"tanh": jnp.tanh, "selu": jax.nn.selu}


@flax.struct.dataclass
class MLP:
    """Dense layers; the last one is linear.

    The layers are unrolled, not scanned: each is one matrix product whose bias and activation
    XLA fuses into one pass.
    """

    #: one matrix a layer, shapes ``(in, width)``, ``(width, width)``, ..., ``(width, out)``.
    weights: tuple[Array, ...]
    biases: tuple[Array, ...]  #: one vector a layer, shapes ``(width,)``, ..., ``(out,)``.
    activation: str = flax.struct.field(pytree_node=False)  #: a name in :data:`ACTIVATIONS`.

    def __call__(self, x: Array) -> Array:
        """Evaluate at inputs of shape ``(..., in)``; returns shape ``(..., out)``."""
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = ACTIVATIONS[self.activation](x @ weight + bias)
        return x @ last[0] + last[1]


def mlp(key: Array, sizes: tuple[int, ...], activation: str, last_scale: float = 1.0) -> MLP:
    """Draw a network with LeCun-normal weights, those of the last layer scaled, and zero biases.

    Sizes are those of input, hidden layers and output; the activation is one of `ACTIVATIONS`.

    Raises:
        ValueError: if a size is below 1, there are fewer than two, or the activation is unknown.
    """
    if activation not in ACTIVATIONS:
        raise ValueError(f"activation {activation!r} is not one of {', '.join(ACTIVATIONS)}")
    if len(sizes) < 2 or min(sizes) < 1:
        raise ValueError(f"layer sizes {sizes} must be two or more numbers, each at least 1")
    scales = [n**-0.5 for n in sizes[:-1]]
    scales[-1] *= last_scale
    weights = tuple(
        scale * jax.random.normal(subkey, (n, m), jnp.float32)
        for scale, subkey, n, m in zip(
            scales, jax.random.split(key, len(scales)), sizes[:-1], sizes[1:], strict=True
        )
    )
    biases = tuple(jnp.zeros(n, jnp.float32) for n in sizes[1:])
    return MLP(weights, biases, activation)


@dataclass(frozen=True)
class Architecture:
    """Shape of a learned plant; the defaults are the paper's for R5C10."""

    pressures: int = 5  #: length of the pressure window, H_p.
    controls: int = 10  #: length of the control window, H_c; the command now is its last entry.
    width: int = 150  #: number of units of each hidden layer.
    depth: int = 9  #: number of matrices, the output's included (the authors' count).
    boundaries: int = 1  #: N_B, one-hidden-layer networks for the first steps of an inspiration.
    boundary_width: int = 100  #: hidden width of the boundary networks (authors' code: 100).
    #: ``"tanh"`` or ``"selu"``, of the general network; boundary ones are tanh.
    activation: str = "tanh"

    def __post_init__(self) -> None:
        """Refuse impossible shapes.

        Raises:
            ValueError: naming the field and its value.
        """
        for name in ("pressures", "controls", "width", "depth", "boundary_width"):
            if getattr(self, name) < 1:
                raise ValueError(f"learned plant: {name} = {getattr(self, name)} must be >= 1")
        if self.boundaries < 0:
            raise ValueError(f"learned plant: boundaries = {self.boundaries} must be >= 0")
        if self.activation not in ACTIVATIONS:
            raise ValueError(
                f"learned plant: activation {self.activation!r} is not one of "
                f"{', '.join(ACTIVATIONS)}"
            )


@dataclass(frozen=True)
class Normalisation:
    """Constants of a learned plant, see :class:`Learned` for units."""

    pressure_mean: float = 16.0
    pressure_scale: float = 9.0
    control_mean: float = 13.0
    control_scale: float = 16.0
    jump_scale: float = 2.0
    rate_scale: float = 2.0
    tau: float = 0.2

    def __post_init__(self) -> None:
        """Refuse scales that are not positive.

        Raises:
            ValueError: naming the constant and its value.
        """
        for name in ("pressure_scale", "control_scale", "jump_scale", "rate_scale", "tau"):
            if not getattr(self, name) > 0:
                raise ValueError(f"learned plant: {name} = {getattr(self, name)} must be positive")


@flax.struct.dataclass
class Boundary:
    """N_B networks of one hidden tanh layer, side by side in two matrices."""

    hidden: Array  #: shape ``(in, N_B * width)``.
    hidden_bias: Array  #: shape ``(N_B * width,)``.
    output: Array  #: shape ``(N_B * width, 2)``.
    output_bias: Array  #: shape ``(N_B, 2)``.

    def __call__(self, x: Array, index: Array) -> Array:
        """Evaluate network ``index`` (shape ``(...)``) at inputs of shape ``(..., in)``.

        All hidden layers are one matrix product; the others' units are then set to zero, so that
        the output is one product too and no weight is gathered. Zero for an index beyond N_B.
        """
        count = self.output_bias.shape[0]
        chosen = (index[..., None] == jnp.arange(count)).astype(x.dtype)
        units = jnp.tanh(x @ self.hidden + self.hidden_bias)
        units = units * jnp.repeat(chosen, units.shape[-1] // count, axis=-1)
        return units @ self.output + chosen @ self.output_bias


@flax.struct.dataclass
class LearnedState:
    """Windows of a learned plant."""

    pressures: Array  #: the last samples, the newest last, cmH2O, shape ``(..., H_p)``.
    controls: Array  #: the last commands, the newest last, %, shape ``(..., H_c)``.
    count: Array  #: steps since the inspiration began, shape ``(...)``.
    peep: Array  #: pressure behind the expiratory valve, cmH2O, shape ``(...)``.


@flax.struct.dataclass
class Learned:
    """Stitched network for the inspiration, first-order relaxation for the expiration.

    *Inspiration.* From the window of pressures and that of controls (the command now included) a
    network gives two numbers, a *jump* and a *rate*, and the next pressure is ``p + jump_scale
    jump (u - u_before) / control_scale + rate_scale rate dt / REFERENCE_DT``. For an R-C lung the
    jump is R times the step of flow, which does not depend on dt, and the rate is flow / C, so
    that a network trained at 31.9 and 34.0 ms is right at 30 ms too; the interval is no input,
    since in the recordings it betrays the rig. Windows hold samples, whatever their interval. At
    one fixed interval this is the paper's family of models. Before the inspiration the windows
    hold the first pressure and command 0. The first N_B steps of an inspiration use a boundary
    network each. All are evaluated at every step and one is selected; they are shallow (authors'
    code), 2 % of a 9 x 150 network's cost each.

    *Expiration* (``u_out`` = 1). The network is not used (the paper learned inspirations only):
    pressure relaxes to PEEP with one time constant whatever ``u_in``, and the windows start anew.

    *Bounds.* ``u_in`` is clipped to the valve's range and the pressure is bent towards ``LOWEST``
    and ``HIGHEST``, so that it stays finite for any sequence of commands.

    *What it cannot promise.* Pressure need not rise with ``u_in``. Where the recordings' commands
    come from a feedback law, the command now tells the pressure now, and a network that sees both
    can learn to read it there (the paper's does so too): its open-loop error on such recordings is
    then better than its physics.

    Source: the paper, section 4.3 and appendix B; authors' code for the boundary networks.
    """

    general: MLP  #: network after the boundary steps.
    boundary: Boundary | None  #: networks of the first steps; None if there are none.
    pressure_mean: Array  #: mean by which pressures of the windows are normalised, cmH2O.
    pressure_scale: Array  #: scale by which pressures of the windows are normalised, cmH2O.
    control_mean: Array  #: mean by which commands of the windows are normalised, %.
    control_scale: Array  #: scale by which commands of the windows are normalised, %.
    jump_scale: Array  #: cmH2O for a unit jump output at a command step of ``control_scale``.
    rate_scale: Array  #: cmH2O in ``REFERENCE_DT`` for a unit rate output.
    tau: Array  #: time constant of expiration, s.
    valve_scale: Array  #: factor on commands, see :meth:`vary`, shape ``(...)`` or ``()``.
    time_scale: Array  #: factor on time constants, see :meth:`vary`, shape ``(...)`` or ``()``.
    windows: tuple[int, int] = flax.struct.field(pytree_node=False)  #: ``(H_p, H_c)``.

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[LearnedState, Signals]:
        """Lung at rest; see :class:`~ventbench.task.interfaces.Plant`."""
        pressure = jnp.asarray(pressure) * 1.0
        behind = pressure if peep is None else jnp.broadcast_to(peep, pressure.shape)
        return self._rest(pressure, behind.astype(pressure.dtype)), Signals(pressure)

    def _rest(self, pressure: Array, peep: Array) -> LearnedState:
        pressures, controls = self.windows
        return LearnedState(
            jnp.broadcast_to(pressure[..., None], (*pressure.shape, pressures)),
            jnp.zeros((*pressure.shape, controls), pressure.dtype),
            jnp.zeros(pressure.shape, jnp.int32),
            peep,
        )

    def step(
        self, state: LearnedState, u_in: Array, u_out: Array, dt: Array
    ) -> tuple[LearnedState, Signals]:
        """One control step; see the class."""
        now = state.pressures[..., -1]
        dt = dt / self.time_scale
        u_in = self.valve_scale * jnp.clip(u_in, 0.0, protocol.U_MAX)
        u_in = jnp.broadcast_to(u_in, now.shape).astype(now.dtype)
        controls = jnp.concatenate([state.controls[..., 1:], u_in[..., None]], axis=-1)
        pressures = (state.pressures - self.pressure_mean) / self.pressure_scale
        commands = (controls - self.control_mean) / self.control_scale
        features = jnp.concatenate([pressures, commands], axis=-1)
        out = self.general(features)
        if self.boundary is not None:
            first = state.count < self.boundary.output_bias.shape[0]
            out = jnp.where(first[..., None], self.boundary(features, state.count), out)
        change = (u_in - state.controls[..., -1]) / self.control_scale
        jump = self.jump_scale * out[..., 0] * change
        rate = self.rate_scale * out[..., 1] * dt / REFERENCE_DT
        inspired = _bend(now + jump + rate)
        expired = state.peep + (now - state.peep) * jnp.exp(-dt / self.tau)

        is_open = jnp.broadcast_to(u_out > 0.5, now.shape)
        pressure = jnp.where(is_open, expired, inspired)
        window = jnp.concatenate([state.pressures[..., 1:], pressure[..., None]], axis=-1)
        going = LearnedState(window, controls, state.count + 1, state.peep)

        def chosen(rest: Array, going: Array) -> Array:
            wide = is_open.reshape(is_open.shape + (1,) * (rest.ndim - now.ndim))
            return jnp.where(wide, rest, going)

        rest = self._rest(pressure, state.peep)
        return jax.tree.map(chosen, rest, going), Signals(pressure)

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> Learned:
        """Return the plant of a lung with other R, C and gain, by two exact symmetries.

        A network has no R and C, but an R-C lung obeys ``p = R q + integral(q dt) / C``: R and
        1 / C together ``r`` times larger answer like ``r`` times the flow; both time constants
        ``s`` times longer answer like steps of ``dt / s``. So commands are multiplied by
        ``r_scale gain`` and intervals divided by ``r_scale c_scale``. Exact for a linear lung and
        valve; the valve's own lag is scaled along, which is small for the few percent that the
        published draws vary.
        """
        return replace(
            self,
            valve_scale=self.valve_scale * r_scale * gain,
            time_scale=self.time_scale * r_scale * c_scale,
        )

    def parameters(self) -> None:
        """Nothing is known of its physics; see :class:`~ventbench.task.interfaces.Plant`."""


def _bend(pressure: Array) -> Array:
    """Bend towards ``LOWEST`` and ``HIGHEST``, the identity between."""
    raised = LOWEST + jax.nn.softplus(pressure - LOWEST)
    return HIGHEST - jax.nn.softplus(HIGHEST - raised)


def learned(
    key: Array, architecture: Architecture, normalisation: Normalisation | None = None
) -> Learned:
    """Draw an untrained learned plant in float32; :func:`ventbench.train.learned.fit` trains one.

    Without a normalisation, that of the recordings' typical values is taken.
    """
    shape, n = architecture, normalisation or Normalisation()
    inputs = shape.pressures + shape.controls
    general_key, hidden_key, output_key = jax.random.split(key, 3)
    # The depth counts matrices, the last included, as the paper does.
    sizes = (inputs, *([shape.width] * (shape.depth - 1)), 2)
    general = mlp(general_key, sizes, shape.activation, last_scale=0.1)
    boundary = None
    if shape.boundaries:
        units = shape.boundaries * shape.boundary_width
        hidden = jax.random.normal(hidden_key, (inputs, units), jnp.float32)
        output = jax.random.normal(output_key, (units, 2), jnp.float32)
        boundary = Boundary(
            hidden * inputs**-0.5,
            jnp.zeros(units, jnp.float32),
            output * 0.1 * shape.boundary_width**-0.5,
            jnp.zeros((shape.boundaries, 2), jnp.float32),
        )
    constants = (jnp.asarray(x, jnp.float32) for x in (*astuple(n), 1.0, 1.0))
    return Learned(general, boundary, *constants, windows=(shape.pressures, shape.controls))
