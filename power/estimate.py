"""What work costs on a device: latency, power, energy, each with an interval, a kind, a boundary and a source.

Two questions are answered. *A workload*: so many multiply-accumulates, back to back, as public submissions measure.
*Our own load*: one window network's frames at a sensor's rate, the device at rest in between: then the device's idle
power decides, and what we add to it is given apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from upbeam.quant.integer import Precision

from . import energy
from .catalogue import CatalogueError, Device, Mode, cpu_core
from .cycles.cpu import CpuCore, CpuTime, cpu_time
from .cycles.fpga import FpgaCore, smallest_core
from .cycles.gpu import gpu_latency, window_work
from .energy import EnergyModel, LeaveOneOut, Row
from .figures import Figure
from .fpga_activity import core_volts, dynamic_energy, toggles_of_a_turn
from .fpga_built import BuiltCores
from .ops import OperationCount

__all__ = [
    "IMPLEMENTATIONS",
    "Bounded",
    "Errors",
    "Estimate",
    "Knowledge",
    "Load",
    "core_clock",
    "default_core",
    "estimate_load",
    "estimate_macs",
]

IMPLEMENTATIONS = {"jetson": ("cpu", "gpu"), "fpga": ("fpga",), "host": ("cpu",)}
"""What each family of devices can run our load on; the first is the default."""
_FAMILY_OF_ROWS = {"jetson": "jetson-gpu", "fpga": "fpga-board"}
_UNMEASURED_DYNAMIC = 2.0
"""Factor of a dynamic energy that no row of the device confirms."""
_UNMEASURED_RATE = 3.0
"""Besides the family's error: of a rate on a device without rows."""
_LUTS_OF_A_MULTIPLIER = Figure(240, 80, 500, "1", "assumption", "1,450 LUTs with 6 multipliers in a routed study")
LUT_LIMIT, MULTIPLIER_LIMIT = 0.7, 0.8
"""Shares of a part that a design may use (FINN's timing closure guide)."""


@dataclass(frozen=True)
class Bounded:
    """A figure and where it is measured: what is inside the boundary."""

    figure: Figure
    boundary: str

    def as_dict(self) -> dict[str, Any]:
        return {**self.figure.as_dict(), "boundary": self.boundary}


@dataclass(frozen=True)
class Errors:
    """What leaving measured rows out says about an estimate, as factors; None where no row tells."""

    power: float | None
    latency_from_macs: float | None
    energy_from_macs: float | None
    rows: int
    of: str
    """the device's own rows, or those of its family"""
    skill: dict[str, float | None]
    """against the constant: 1 is perfect, 0 no better, below 0 worse"""

    def as_dict(self) -> dict[str, Any]:
        return dict(vars(self))


@dataclass(frozen=True)
class Load:
    """Frames of a window network at a sensor's rate."""

    count: OperationCount
    pairs: tuple[int, int]
    """of hidden units, without and with a slope, both networks"""
    precision: str = "int8"
    rate_hz: float = 20.0
    deadline_ms: float = 50.0
    memory: dict[str, int] = field(default_factory=dict)
    """``tables``, ``weights``, ``state`` in bytes"""

    @property
    def columns(self) -> int:
        return self.count.columns

    @property
    def macs(self) -> int:
        """Executed for a frame."""
        return 2 * self.count.macs_folded * self.count.windows

    @property
    def fpga_precision(self) -> Precision:
        """The core has no float: int8 instead."""
        return "int16" if self.precision == "int16" else "int8"

    @property
    def period_ms(self) -> float:
        return 1e3 / self.rate_hz


@dataclass(frozen=True)
class Knowledge:
    """Measured rows, the model fitted on them, and its leave-one-out errors."""

    model: EnergyModel
    results: tuple[LeaveOneOut, ...]

    @classmethod
    def of(cls, rows: Sequence[Row] | None = None) -> Knowledge:
        rows = energy.measured_rows() if rows is None else rows
        return cls(energy.fit(rows), tuple(energy.leave_one_out(rows)))

    def rows(self, device: str) -> list[Row]:
        return [row for row in self.model.rows if row.device == device]

    def errors(self, device: Device) -> Errors:
        """Of the device's own rows where two or more tell, of its family's where it has one. A device without any row
        borrows the family's error of latency alone: nothing tells how far off its power is."""
        own = [x for x in self.results if x.row.device == device.name]
        family = _FAMILY_OF_ROWS.get(device.family, "")
        chosen, of = (own, "its own rows") if len(own) > 1 else (self._of_family(family), f"rows of {family or 'none'}")
        worst = {what: max((f for x in chosen if (f := x.factor(what))), default=None) for what in _WHATS}
        if not own:
            return Errors(None, worst["latency"], None, 0, "no row of its own", dict.fromkeys(_WHATS))
        skill = {what: energy.skill(chosen, what) for what in _WHATS}
        return Errors(worst["power"], worst["latency"], worst["energy"], len(chosen), of, skill)

    def _of_family(self, family: str) -> list[LeaveOneOut]:
        return [x for x in self.results if x.row.family == family]


_WHATS = ("power", "latency", "energy")


@dataclass(frozen=True)
class Estimate:
    """What work costs on a device. ``power_w`` is the mean while the work is done (a workload) or over a whole turn
    (our load); ``energy_mj`` is of one inference or one frame of that power. ``increment_*``: over the idle device."""

    device: Device
    implementation: str
    mode: Mode | None
    workload: str
    macs: float
    latency_ms: Bounded
    power_w: Bounded
    energy_mj: Bounded
    errors: Errors
    dominates: str
    increment_w: Bounded | None = None
    increment_mj: Bounded | None = None
    deadline_ms: float | None = None
    sensors: tuple[int, int, int] | None = None
    """that fit on the device at this rate: central, low, high"""
    memory: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def met(self) -> str | None:
        """Is the deadline met? ``yes`` and ``no`` only where the whole interval says so."""
        if self.deadline_ms is None or not self.latency_ms.figure.known:
            return None
        _, low, high = self.latency_ms.figure.span("ms")
        return "yes" if high <= self.deadline_ms else "no" if low > self.deadline_ms else "not certain"

    @property
    def margin_ms(self) -> Figure | None:
        """Deadline less latency."""
        if self.met is None or self.deadline_ms is None:
            return None
        value, low, high = (self.deadline_ms - x for x in self.latency_ms.figure.span("ms"))
        return Figure(value, high, low, "ms", self.latency_ms.figure.kind, self.latency_ms.figure.source)

    def as_dict(self) -> dict[str, Any]:
        """Fit for JSON."""
        bounded = {key: getattr(self, key) for key in ("latency_ms", "power_w", "energy_mj", *_INCREMENTS)}
        return {
            "device": self.device.name,
            "title": self.device.title,
            "implementation": self.implementation,
            "mode": self.mode.name if self.mode else None,
            "workload": self.workload,
            "macs": self.macs,
            **{key: None if value is None else value.as_dict() for key, value in bounded.items()},
            "deadline_ms": self.deadline_ms,
            "met": self.met,
            "margin_ms": None if self.margin_ms is None else self.margin_ms.as_dict(),
            "sensors": None if self.sensors is None else dict(zip(("value", "low", "high"), self.sensors, strict=True)),
            "memory": self.memory,
            "leave_one_out": self.errors.as_dict(),
            "dominates": self.dominates,
            "notes": list(self.notes),
        }


_INCREMENTS = ("increment_w", "increment_mj")


# ------------------------------------------------------------------------------------------------------- a workload


def estimate_macs(
    device: Device, macs: float, latency_ms: float | None = None, *, known: Knowledge, mode: str | None = None
) -> Estimate:
    """A workload of ``macs`` multiply-accumulates, back to back. ``latency_ms`` of one, where it is known: without it
    the error is large, and printed. Raises CatalogueError for a mode the device does not have."""
    errors, chosen = known.errors(device), device.mode(mode)
    if device.family == "host":
        return _on_unknown(device, macs, latency_ms, errors)
    if latency_ms is None:
        latency = _latency_from_macs(device, macs, known, errors)
    else:
        latency = Figure.exact(latency_ms, "ms", "given", "given by the user")
    row = _row_like(device, macs, latency.get("ms"), known)
    power = _working_power(device, row, known, errors)
    joules = _product(power, latency.to("s"), "J").to("mJ")
    boundary = _boundary(device, known)
    return Estimate(
        device, _macs_run_on(device), chosen, f"{macs:.4g} MAC, back to back", macs,
        Bounded(latency, "one inference"), Bounded(power, f"{boundary}, while computing"),
        Bounded(joules, f"{boundary}, one inference"), errors, _dominates(device, row, known),
        notes=_notes(device, known),
    )  # fmt: skip


def _on_unknown(device: Device, macs: float, latency_ms: float | None, errors: Errors) -> Estimate:
    """A workload on a machine that nothing is known of but what it was told."""
    if latency_ms is None:
        raise CatalogueError(
            f"{device.name}: no measured row tells its latency: give --latency-ms, or leave --macs out"
        )
    why = "no measured row of this machine: power is not known"
    return Estimate(
        device, "cpu", None, f"{macs:.4g} MAC, back to back", macs,
        Bounded(Figure.exact(latency_ms, "ms", "given", "given by the user"), "one inference"),
        Bounded(Figure.absent("W", why), "none"), Bounded(Figure.absent("mJ", why), "none"), errors, "not known",
    )  # fmt: skip


def _macs_run_on(device: Device) -> str:
    return "gpu" if device.family == "jetson" else IMPLEMENTATIONS[device.family][0]


def _row_like(device: Device, macs: float, latency_ms: float, known: Knowledge) -> Row:
    """The workload as a row of the device, to ask the model about."""
    family = _FAMILY_OF_ROWS.get(device.family, "")
    node = device.figures["power.node"].get("nm") if "power.node" in device.figures else energy.REFERENCE_NODE_NM
    own = known.rows(device.name)
    if own:
        return replace(own[0], macs=macs, latency_ms=latency_ms, workload="", source="", energy_uj=None)
    return Row(device.name, device.title, family, "", node, "", macs, latency_ms, 0.0, "")


def _latency_from_macs(device: Device, macs: float, known: Knowledge, errors: Errors) -> Figure:
    row = _row_like(device, macs, 1.0, known)
    rate = known.model.rate(row)
    launch = device.figures["gpu.launch"].span("ms") if "gpu.launch" in device.figures else (0.0, 0.0, 0.0)
    own = bool(known.rows(device.name))
    factor = max(errors.latency_from_macs or 1.0, energy.LEAST_FACTOR) * (1.0 if own else _UNMEASURED_RATE)
    ms = macs / rate * 1e3
    source = (
        f"{rate / 1e9:.3g} GMAC/s, the geometric mean of {'its own' if own else 'its family of'} measured rows; "
        f"leave-one-out: off by up to a factor {factor:.3g}. Architecture decides, not multiply-accumulates"
    )
    kind = "modelled" if own else "assumption"
    return Figure(launch[0] + ms, launch[1] + ms / factor, launch[2] + ms * factor, "ms", kind, source)


def _working_power(device: Device, row: Row, known: Knowledge, errors: Errors) -> Figure:
    """While computing."""
    if row.device in known.model.static_w:
        factor = max(energy.LEAST_FACTOR, errors.power or 0.0)
        source = f"static and dynamic power fitted on measured rows; leave-one-out of {errors.of}: factor {factor:.3g}"
        if row.device in known.model.own_dynamic_j:
            factor = energy.LEAST_FACTOR
            source = f"static and dynamic power of the user's own rows, which it meets; factor {factor:.3g} assumed"
        return Figure.within(known.model.power_w(row), factor, "W", "modelled", source)
    dynamic = known.model.dynamic_of(row) * row.scaled_rate
    idle, low, high = device.figure("power.idle").span("W")
    source = f"no measured row: idle power ({device.figure('power.idle').source}) and the family's dynamic energy"
    return Figure(idle + dynamic, low + dynamic / _UNMEASURED_DYNAMIC, high + dynamic * _UNMEASURED_DYNAMIC, "W",
                  "assumption", source)  # fmt: skip


def _boundary(device: Device, known: Knowledge) -> str:
    rows = [row for row in known.rows(device.name) if not row.is_idle]
    return device.texts.get("power.boundary") or (rows[0].boundary if rows else "unknown")


# ------------------------------------------------------------------------------------------------------- our own load


def estimate_load(
    device: Device,
    load: Load,
    *,
    known: Knowledge,
    implementation: str | None = None,
    mode: str | None = None,
    core: FpgaCore | None = None,
    built: BuiltCores | None = None,
) -> Estimate:
    """Frames of a window network at a rate. ``implementation``: of ``IMPLEMENTATIONS``. ``core``: the FPGA core,
    ``default_core`` if omitted; ``built``: what is known of cores of the model. Not for the host, which is measured
    (``power/host.py``). Raises CatalogueError."""
    runs_on = implementation or IMPLEMENTATIONS[device.family][0]
    if runs_on not in IMPLEMENTATIONS[device.family] or device.family == "host":
        raise CatalogueError(f"{device.name} runs our load on {', '.join(IMPLEMENTATIONS[device.family])}")
    chosen = device.mode(mode)
    if runs_on == "fpga":
        return _on_fpga(device, load, known, core, built or BuiltCores())
    return (_on_cpu if runs_on == "cpu" else _on_gpu)(device, load, known, chosen)


def cpu_column_time(device: Device, load: Load, mode: Mode | None) -> CpuTime:
    """Of one column on one core of a device of the catalogue."""
    clock = mode.get("cpu_clock") if mode else None
    if clock is None:
        raise CatalogueError(f"{device.name}: no CPU clock to estimate with")
    core: CpuCore = cpu_core(device.texts["cpu.core"])
    bandwidth = device.figure("memory.bandwidth").get("GB/s")
    found = cpu_time(core, device.texts["cpu.isa"], load.precision, load.pairs, clock.get("GHz"), bandwidth)
    return CpuTime(*(_at_clock(figure, clock) for figure in (found.kernels, found.push)))


def _at_clock(time: Figure, clock: Figure) -> Figure:
    """The interval of the clock widens that of the time."""
    value, low, high = time.span("ns")
    central, slow, fast = clock.span("GHz")
    return replace(time, value=value, low=low * central / fast, high=high * central / slow, unit="ns")


def _on_cpu(device: Device, load: Load, known: Knowledge, mode: Mode | None) -> Estimate:
    assert mode is not None
    latency = cpu_column_time(device, load, mode).frame(load.columns)
    fastest = max(m.figures["cpu_clock"].get("MHz") for m in device.modes.values())
    share = mode.figures["cpu_clock"].get("MHz") / fastest
    busy = _busy(latency, load)
    active = device.figure("power.cpu_active").span("W")
    watts = [b * a * share for b, a in zip(busy, active, strict=True)]
    source = f"one core busy {100 * busy[0]:.2g} % of the time x its power over idle (assumed)"
    increment = Figure(watts[0], watts[1], watts[2], "W", "assumption", source)
    cores = int(mode.figures["cpu_cores"].get("1"))
    sensors = tuple(int(load.period_ms / x) * cores for x in (latency.span("ms")[k] for k in (0, 2, 1)))
    what = f"both images of a 32 x {load.columns} frame in {load.precision}, one core, {load.rate_hz:g} Hz"
    memory = {**load.memory, "of": device.figure("memory.size").get("B")}
    return _at_rate(device, "cpu", mode, what, load, latency, increment, known, sensors, memory)


def _on_gpu(device: Device, load: Load, known: Knowledge, mode: Mode | None) -> Estimate:
    assert mode is not None
    work = window_work(load.count)
    share = mode.figures["gpu_clock"].get("MHz") / device.figure("gpu.clock").get("MHz")
    peak = device.figure("gpu.peak")
    slower = replace(peak, **{k: getattr(peak, k) * share for k in ("value", "low", "high")})
    reached = energy.peak_share(known.model.rows)
    latency = gpu_latency(work, slower, reached, device.figure("memory.bandwidth"), device.figure("gpu.launch"))
    busy = _busy(latency, load)
    full = _full_load_increment(device, mode, known)
    low = known.model.dynamic_j.get("jetson-gpu", 0.0) * _node(device) * load.macs * load.rate_hz
    watts = (max(low, busy[0] * full / 2), min(low, busy[1] * full / 2), max(low, busy[2] * full))
    source = f"GPU busy {100 * busy[0]:.2g} % of the time x half of what full load adds ({full:.3g} W)"
    increment = Figure(watts[0], watts[1], watts[2], "W", "assumption", source)
    sensors = tuple(int(load.period_ms / x) for x in (latency.span("ms")[k] for k in (0, 2, 1)))
    what = f"both images of a 32 x {load.columns} frame, exported ONNX under TensorRT, {load.rate_hz:g} Hz"
    memory = {"bytes": int(work.bytes[0]), "of": device.figure("memory.size").get("B")}
    return _at_rate(device, "gpu", mode, what, load, latency, increment, known, sensors, memory)


def _full_load_increment(device: Device, mode: Mode, known: Knowledge) -> float:
    """What a large network adds to the idle device, W: measured, or up to the mode's budget."""
    idle = _idle(device, known).get("W")
    work = [row.power_w for row in known.rows(device.name) if not row.is_idle]
    budget = mode.get("budget")
    limit = max(work) if work else budget.get("W") if budget else 2 * idle
    return max(limit - idle, 0.1 * idle)


def default_core(device: Device, load: Load, built: BuiltCores | None = None) -> FpgaCore:
    """The least fold above 1 that fits a part, of those whose LUTs are known where any are. Raises FpgaCoreError."""
    hidden, there = load.count.folded_hidden, int(device.figure("fpga.multipliers").get("1"))
    most = built.most_multipliers(device.name, load.fpga_precision, hidden) if built else None
    return smallest_core(there, hidden, MULTIPLIER_LIMIT, precision=load.fpga_precision, known=most)


def core_clock(device: Device, core: FpgaCore, built: BuiltCores | None) -> Figure:
    """As routed or fitted, else of the catalogue."""
    return (built.clock(device.name, core) if built else None) or device.figure("fpga.clock")


def _on_fpga(device: Device, load: Load, known: Knowledge, core: FpgaCore | None, built: BuiltCores) -> Estimate:
    core = core or default_core(device, load, built)
    clock = core_clock(device, core, built)
    latency = core.latency(clock, load.columns)
    increment, notes = _fpga_increment(device, load, core, clock, built)
    sensors = tuple(int(load.period_ms / x) for x in (latency.span("ms")[k] for k in (0, 2, 1)))
    what = (
        f"both images of a 32 x {load.columns} frame in {core.precision}, LANES {core.lanes}, FOLD {core.fold}, "
        f"{load.rate_hz:g} Hz"
    )
    used = _fit(device, core, load, built)
    found = _at_rate(device, "fpga", None, what, load, latency, increment, known, sensors, used)
    return replace(found, notes=(*found.notes, *notes))


def _fpga_increment(
    device: Device, load: Load, core: FpgaCore, clock: Figure, built: BuiltCores
) -> tuple[Figure, tuple[str, ...]]:
    """Dynamic power, W, and what is to be said of it: of the core's switching activity where it was simulated and the
    part is of the process that a toggle's energy is stated for, else of multiply-accumulates."""
    activity, volts = built.activity(core), core_volts(device)
    if activity is None or volts is None:
        value, low, high = (x * load.macs * load.rate_hz for x in device.figure("power.mac_energy").span("J/MAC"))
        return Figure(value, low, high, "W", "assumption", device.figure("power.mac_energy").source), ()
    turn_s = load.period_ms / 1e3
    every, working = toggles_of_a_turn(activity, load.columns, clock.get("Hz"), turn_s)
    energy, least = dynamic_energy(every, volts), dynamic_energy(working, volts)
    value, low, high = (x / turn_s for x in energy.span("J"))
    source = (
        f"switching activity of {activity['frame']} ({activity['tool']}) at {clock.get('MHz'):.1f} MHz, "
        f"{100 * working / every:.0f} % of it while computing: {energy.source}"
    )
    slow_mhz = core.column_cycles * load.columns * load.rate_hz / 1e6
    central, least_mj, most_mj = least.span("mJ")
    note = (
        f"The core's schedule toggles while it waits. With its clock enabled only for frames, or at the {slow_mhz:.3g} "
        f"MHz that carry this rate, the added energy is {central:.2g} mJ a frame ({least_mj:.2g} to {most_mj:.2g})."
    )
    unseen = "Dynamic power is modelled from RTL activity, which misses glitches; the clock tree is not in it."
    return Figure(value, low, high, "W", "modelled", source), (unseen, note)


def _luts(device: Device, core: FpgaCore, built: BuiltCores) -> tuple[Figure, str]:
    """And how they are known."""
    found = built.luts(device.name, core)
    if found is not None:
        return found, "routed (nextpnr)" if found.kind == "simulated" else "fitted"
    luts, low, high = (x * core.multipliers for x in _LUTS_OF_A_MULTIPLIER.span("1"))
    return Figure(luts, low, high, "1", "assumption", _LUTS_OF_A_MULTIPLIER.source), "assumption"


def _fit(device: Device, core: FpgaCore, load: Load, built: BuiltCores) -> dict[str, Any]:
    """What of the part is used."""
    luts, label = _luts(device, core, built)
    there = device.figure("fpga.luts").get("1")
    multipliers = device.figure("fpga.multipliers").get("1")
    # Three prepared columns of four rows, 16 bits; weights of both networks.
    bits = 3 * 4 * 32 * 16 + 8 * load.count.weight_bytes_folded(core.precision)
    _, low, high = luts.span("1")
    fits = "yes" if high <= LUT_LIMIT * there else "no" if low > LUT_LIMIT * there else "not certain"
    if luts.kind == "simulated":
        fits = "yes"  # it was placed and routed there
    return {
        "multipliers": core.multipliers,
        "multipliers_of": int(multipliers),
        "luts": {**luts.as_dict(), "label": label},
        "luts_of": int(there),
        "ram_bits": bits,
        "ram_bits_of": int(device.figure("fpga.ram").get("B") * 8),
        "fits": fits if core.multipliers <= multipliers else "no",
    }


def _at_rate(
    device: Device, runs_on: str, mode: Mode | None, what: str, load: Load, latency: Figure, increment: Figure,
    known: Knowledge, sensors: Sequence[int], memory: dict[str, Any],
) -> Estimate:  # fmt: skip
    """Idle power and an increment, over whole turns."""
    idle = _idle(device, known)
    value, low, high = (a + b for a, b in zip(idle.span("W"), increment.span("W"), strict=True))
    kind = "assumption" if idle.kind == "assumption" else "modelled"
    power = Figure(
        value, low, high, "W", kind, f"at rest ({idle.kind}): {idle.source}; plus ({increment.kind}) {increment.source}"
    )
    turn = Figure.exact(load.period_ms, "ms", "given", "the sensor's turn").to("s")
    boundary = _boundary(device, known)
    rest = idle.get("W") / value
    dominates = (
        f"{100 * rest:.1f} % of it is what the device draws at rest; the work adds {_si(increment.get('W'), 'W')} "
        f"({_si(increment.span('W')[1], 'W')} to {_si(increment.span('W')[2], 'W')})"
    )
    return Estimate(
        device, runs_on, mode, what, load.macs, Bounded(latency, "computing of a frame, nothing else on the device"),
        Bounded(power, f"{boundary}, mean over a turn"),
        Bounded(_product(power, turn, "J").to("mJ"), f"{boundary}, one turn of {load.period_ms:g} ms"),
        known.errors(device), dominates,
        Bounded(increment, f"{boundary}, over the idle device"),
        Bounded(_product(increment, turn, "J").to("mJ"), f"{boundary}, one frame, over the idle device"),
        load.deadline_ms, (sensors[0], sensors[1], sensors[2]), memory, _notes(device, known),
    )  # fmt: skip


def _idle(device: Device, known: Knowledge) -> Figure:
    """At rest: of the user's own idle rows, else of the catalogue, else the static power fitted on working rows."""
    own = [row for row in known.rows(device.name) if row.is_idle and row.by_user]
    if own:
        mean = sum(row.power_w for row in own) / len(own)
        return Figure.within(mean, energy.LEAST_FACTOR, "W", "measured by the user", own[-1].source)
    if "power.idle" in device.figures:
        return device.figures["power.idle"]
    if device.name not in known.model.static_w:
        raise CatalogueError(f"{device.name}: neither an idle power nor a measured row")
    factor = max(energy.LEAST_FACTOR, known.errors(device).power or 0.0)
    source = "static power fitted on rows measured at work; not measured at rest"
    return Figure.within(known.model.static_w[device.name], factor, "W", "modelled", source)


def _busy(latency: Figure, load: Load) -> tuple[float, float, float]:
    value, low, high = (min(1.0, x / load.period_ms) for x in latency.span("ms"))
    return value, low, high


def _node(device: Device) -> float:
    return device.figure("power.node").get("nm") / energy.REFERENCE_NODE_NM


def _product(one: Figure, other: Figure, unit: str) -> Figure:
    """Of two positive figures in base units; intervals multiply."""
    a, b = one.span("W"), other.span("s")
    kind = one.kind if other.kind in ("given", one.kind) else _weaker(one.kind, other.kind)
    return Figure(a[0] * b[0], a[1] * b[1], a[2] * b[2], unit, kind, f"power x time; power: {one.source}")


def _weaker(*kinds: str) -> str:
    """Of a result made of several: an assumption stays one."""
    return "assumption" if "assumption" in kinds else "modelled"


def _dominates(device: Device, row: Row, known: Knowledge) -> str:
    static = known.model.static_w.get(device.name)
    if static is None:
        static = device.figure("power.idle").get("W")
    dynamic = known.model.dynamic_of(row) * row.scaled_rate
    share = static / (static + dynamic)
    parts = f"{100 * share:.1f} % of the power while computing; multiply-accumulates: {100 - 100 * share:.1f} %"
    return f"static power: {parts}"


def _notes(device: Device, known: Knowledge) -> tuple[str, ...]:
    found = [device.note] if device.note else []
    if not known.rows(device.name) and device.family != "host":
        found.append("No measured row of this device: its power is an assumption.")
    return tuple(found)


def _si(watts: float, unit: str) -> str:
    for size, letter in ((1.0, ""), (1e-3, "m"), (1e-6, "u")):
        if watts >= size:
            return f"{watts / size:.3g} {letter}{unit}"
    return f"{watts / 1e-9:.3g} n{unit}"
