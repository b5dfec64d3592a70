"""The catalogue: what each fault must lead to. ``upbeam hil faults --markdown`` prints docs/faults.md of it.

Times hold at 20 turns a second with the device's default settings, counted from the fault's begin (detection) or end
(health). They follow from how often the device looks (once a frame, 50 ms; timeouts every 5 ms) and from the debounce
of the fault code: 1, 2, 3 or 8 looks until it is set, 1, 4, 8 or 16 until it is clear. Scenarios hold the device to
them.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields

from .base import FAULTS, DeviceFault, Fault

__all__ = ["CATALOGUE", "Entry", "markdown"]


@dataclass(frozen=True)
class Entry:
    """What must come of one kind of fault."""

    detects: str | None
    """The fault code that must be set; None: nothing is to be detected, the fault is borne."""
    within_ms: float | None
    """After the begin."""
    meanwhile: str
    """What the output does while it lasts."""
    healthy_ms: float | None
    """After the end, until the code is clear; None: it stays until somebody acts."""
    also: tuple[str, ...] = ()
    """Codes that may be set besides."""


CATALOGUE: dict[str, Entry] = {
    # network
    "loss": Entry("NET_LOSS", 200, "Columns that never arrived are inserted as no return, flagged and counted.", 470),
    "burst_loss": Entry("NET_LOSS", 300, "As with single losses; gaps of more than a turn begin the stream anew.", 470),
    "silence": Entry(
        "SENSOR_TIMEOUT", 70, "What was received leaves within 70 ms; then nothing. State NO_SENSOR.", 10
    ),
    "duplicate": Entry("NET_DUPLICATE", 200, "The second copy is dropped: each firing is one column.", 470),
    "reorder": Entry(
        "NET_REORDER", 250, "Overtaken packets are dropped as late, their columns inserted.", 470, ("NET_LOSS",)
    ),
    "jitter": Entry("NET_JITTER", 300, "Columns leave as packets come; none is lost.", 470),
    "truncate": Entry("NET_MALFORMED", 200, "Dropped whole; their columns are inserted.", 250, ("NET_LOSS",)),
    "wrong_size": Entry("NET_MALFORMED", 200, "Dropped whole; their columns are inserted.", 250, ("NET_LOSS",)),
    "corrupt": Entry("NET_MALFORMED", 200, "Dropped whole; their columns are inserted.", 250, ("NET_LOSS",)),
    "wrong_port": Entry("SENSOR_TIMEOUT", 70, "As with silence.", 10),
    "flood": Entry(
        "NET_FLOOD", 30, "Foreign packets are dropped at their header; the sensor's go through, in time.", 400,
        ("NET_MALFORMED",),
    ),
    # sensor
    "stuck_azimuth": Entry(
        "SENSOR_AZIMUTH_STUCK", 250, "Nothing leaves: the measured directions are unknown.", 400, ("SENSOR_TIMEOUT",)
    ),
    "azimuth_jump": Entry("SENSOR_AZIMUTH_JUMP", 5, "The stream begins anew at the new azimuth, at once.", 400),
    "rpm": Entry("SENSOR_RPM_RANGE", 250, "Columns follow the azimuth; the turn has as many as were fired.", 470),
    "dead_laser": Entry("SENSOR_BEAM_DEAD", 300, "Its row is empty; generated rows beside it use the other beam.", 470),
    "stuck_ring": Entry(
        "SENSOR_RING_STUCK", 300, "Its row leaves as it came: verbatim, and said to be wrong.", 470,
        ("SENSOR_CROSSTALK",),
    ),
    "all_zero": Entry(
        "SENSOR_ALL_ZERO", 250, "Columns without a return; nothing is generated.", 400,
        ("SENSOR_VISIBILITY", "SENSOR_BEAM_DEAD"),
    ),
    "saturated": Entry(None, None, "Verbatim. A bright scene looks the same.", None),
    "time_jump": Entry(
        "SENSOR_TIME_JUMP", 10, "One packet waits for another that confirms the new time; then the stream begins anew.",
        400,
    ),
    "thermal_shutdown": Entry(
        "SENSOR_THERMAL", 600, "As with silence; the telemetry says why.", 600, ("SENSOR_TIMEOUT",)
    ),
    "pps_lost": Entry("SENSOR_PPS_LOST", 500, "Goes on.", 900),
    "wrong_model": Entry(
        "SENSOR_WRONG_MODEL", 400, "Dropped whole, never misread; then as with silence.", 400,
        ("SENSOR_TIMEOUT", "NET_FLOOD"),
    ),
    # physics
    "beams_missing": Entry("SENSOR_BEAM_DEAD", 300, "Their rows are empty; nothing is generated between two.", 470),
    "crosstalk": Entry("SENSOR_CROSSTALK", 470, "Measured rows leave verbatim.", 870),
    "fog": Entry(
        "SENSOR_VISIBILITY", 470, "Measured rows leave verbatim. Light fog may pass unreported.", 870,
        ("SENSOR_CROSSTALK", "SENSOR_BEAM_DEAD"),
    ),
    # compute
    "bit_flip": Entry(
        "COMPUTE_INTEGRITY", 400, "Repaired from a copy, and the stream begins anew; without a good copy no row is "
        "generated. The kept file can only come from outside: that stays reported.", 1000,
    ),
    "slow_down": Entry(
        "COMPUTE_OVERLOAD", 400, "The degradation ladder: valid means, repeated rows, measured rows only; packets that "
        "waited longer than 40 ms are dropped as stale.", 3000, ("COMPUTE_THROTTLE", "COMPUTE_DEADLINE", "NET_LOSS"),
    ),
    "throttle": Entry("COMPUTE_THROTTLE", 700, "Goes on; reported before anything is late.", 870),
    "clock_drift": Entry("CLOCK_DRIFT", 5100, "Goes on.", 9100),
    # bus
    "bus_off": Entry("CAN_BUS_OFF", 300, "The point stream goes on; status is lost and counted.", 400),
    "wrong_crc": Entry(None, None, "The receiver's end-to-end check refuses each damaged message.", None),
    "serial_noise": Entry(
        "SERIAL_FRAMING", 300, "No command is taken from noise; the next whole record is read.", 5100
    ),
    # power
    "reset": Entry(
        "POWER_RESET", 60, "Starts anew with the next packet; fault memory and freshness counter are kept.", 500
    ),
}  # fmt: skip

_GROUPS = {
    "network": "Network", "sensor": "Sensor", "physics": "Physics of the medium", "compute": "Computer",
    "bus": "Buses", "power": "Supply",
}  # fmt: skip
_HEAD = """# Faults

<!-- Written by `upbeam hil faults --markdown`; do not edit. -->

What the bench can do to sensor, network, computer, buses and supply, and what the device must make of it. A fault is a
table in a scenario (docs/hil.md), with a seed; any number may act at once. Faults of packets are transforms of the
datagrams, the same for the simulated sensor, a recording and a socket.

Times are milliseconds at 20 turns a second and default settings: *within* from the fault's begin until its code is set,
*healthy* from its end until the code is clear. They follow from how often the device looks (once a frame; timeouts
every 5 ms) and from each code's debounce ([can.md](can.md)). The scenarios in `tests/hil` hold the device to them;
their measured times are in the output of `upbeam hil run`. In every case measured rows leave verbatim, nothing is
invented, and packets sent are packets accounted for.

Every fault knows `from_s` and `until_s` (or `from_frame`, `until_frame`: turns) and `seed`.
"""


def markdown() -> str:
    """docs/faults.md."""
    lines = [_HEAD]
    for group, title in _GROUPS.items():
        lines += [f"## {title}", "", *_table(group), ""]
    lines += [_fog()]
    return "\n".join(lines).replace("``", "`")


def _table(group: str) -> list[str]:
    lines = [
        "| fault | settings | code | within | meanwhile | healthy |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for kind, cls in FAULTS.items():
        if cls.group != group:
            continue
        entry = CATALOGUE[kind]
        code = f"`{entry.detects}`" if entry.detects else "none"
        if entry.also:
            code += " (may be: " + ", ".join(f"`{name}`" for name in entry.also) + ")"
        what = " ".join((cls.__doc__ or "").split())
        cells = [
            f"`{kind}`: {what}",
            _settings(cls),
            code,
            _ms(entry.within_ms),
            entry.meanwhile,
            _ms(entry.healthy_ms),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _ms(value: float | None) -> str:
    return "" if value is None else f"{value:g}"


def _settings(cls: type[Fault]) -> str:
    general = {f.name for f in fields(Fault)}
    own = [f for f in fields(cls) if f.name not in general]
    shown = [f"`{f.name}` = {f.default}" for f in own if f.default is not MISSING]
    once = issubclass(cls, DeviceFault) and cls.once
    return ", ".join([*shown, *(["strikes once"] if once else [])])


def _fog() -> str:
    from .physics import FOG_VISIBILITY_M, FogOptics

    reach = ", ".join(f"{name} {metres:g} m" for name, metres in FOG_VISIBILITY_M.items())
    text, optics = " ".join((FogOptics.__doc__ or "").split()), FogOptics(1.0)
    return (
        f"## The fog\n\nModelled, not measured. Meteorological optical range of the severities: {reach}.\n\n{text}\n\n"
        f"Assumptions: {optics.reach_10_m:g} m reach for a 10 % target in clear air, full gain from "
        f"{optics.full_gain_m:g} m, overlap of laser and receiver from {optics.overlap_m:g} m, a pulse of "
        f"{optics.pulse_m:g} m.\n"
    )
