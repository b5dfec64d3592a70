"""Power sensors: tegrastats of three JetPacks, INA3221 in two drivers, RAPL, on text and trees made for the tests."""

from __future__ import annotations

import math
import stat

import pytest
from hypothesis import given
from hypothesis import strategies as st

from upbeam.power.measure import MeasureError, Recording, find_sensors, record, total_power
from upbeam.power.measure.rails import increment
from upbeam.power.measure.sensors import no_sensor
from upbeam.power.measure.sysfs import rapl_domains, rapl_energy_j, read_rails
from upbeam.power.measure.tegrastats import parse_line, read_log, record_live

NANO_4 = (
    "RAM 1811/3956MB (lfb 12x4MB) SWAP 20/1978MB (cached 1MB) IRAM 0/252kB(lfb 252kB) CPU [12%@1479,8%@1479,off,3%@1479"
    "] EMC_FREQ 3%@1600 GR3D_FREQ 25%@614 APE 25 PLL@33.5C CPU@36C PMIC@50C GPU@34.5C AO@41C thermal@35C "
    "POM_5V_IN 3120/2950 POM_5V_GPU 204/190 POM_5V_CPU 810/702"
)  # fmt: skip
TX2_4 = (
    "RAM 2301/7858MB (lfb 900x4MB) SWAP 0/3929MB (cached 0MB) CPU [9%@345,off,off,3%@345,1%@345,1%@345] EMC_FREQ 0% "
    "GR3D_FREQ 0% APE 150 MTS fg 0% bg 0% BCPU@41C MCPU@41C GPU@40C PLL@41C Tboard@38C Tdiode@40.25C PMIC@100C "
    "thermal@40.9C VDD_IN 3255/3301 VDD_CPU 536/550 VDD_GPU 153/153 VDD_SOC 536/541 VDD_WIFI 0/12 VDD_DDR 595/600"
)  # fmt: skip
AGX_4 = (
    "RAM 3005/15697MB (lfb 2817x4MB) SWAP 0/7848MB (cached 0MB) CPU [4%@1190,2%@1190,off,off] EMC_FREQ 0% GR3D_FREQ 0% "
    "AO@33C GPU@34C Tdiode@38.25C PMIC@100C AUX@33.5C CPU@34.5C thermal@34C Tboard@36C GPU 0/0 CPU 311/340 SOC 932/950 "
    "CV 0/0 VDDRQ 155/160 SYS5V 1478/1480"
)  # fmt: skip
ORIN_5 = (
    "03-14-2024 08:15:{second:02d} RAM 2406/7471MB (lfb 4x2MB) SWAP 0/3735MB (cached 0MB) CPU [5%@1510,2%@1510,0%@1510,"
    "0%@729,off,off] EMC_FREQ 0%@2133 GR3D_FREQ 0%@305 GR3D2_FREQ 0%@305 VIC_FREQ off APE 174 CV0@-256C CPU@48.5C "
    "SOC2@47.1C tj@48.5C VDD_IN {mw}mW/4100mW VDD_CPU_GPU_CV 600mW/590mW VDD_SOC 1230mW/1225mW"
)  # fmt: skip
AGX_ORIN_6 = (
    "07-01-2025 09:08:28 RAM 20642/62817MB (lfb 1x2MB) CPU [23%@2201,10%@2201] EMC_FREQ 3%@3199 GR3D_FREQ 0%@[1300,1300"
    "] NVENC0 off NVDEC0_FREQ @[0,0] APE 174 cpu@52.968C/52.968C tj@53.1C NEW_TOKEN 12/x [1|2] VDD_GPU_SOC"
    " 2400mW/2398mW VDD_CPU_CV 800mW/790mW VIN_SYS_5V0 4800mW/4790mW NC 0mW/0mW"
)  # fmt: skip


@pytest.mark.parametrize(
    ("line", "watts", "boundary"),
    [
        (NANO_4, 3.120, "input rail POM_5V_IN"),
        (TX2_4, 3.255, "input rail VDD_IN"),
        (AGX_4, 0.311 + 0.932 + 0.155 + 1.478, "sum of 6 rails"),
        (ORIN_5.format(second=1, mw=4321), 4.321, "input rail VDD_IN"),
        (AGX_ORIN_6, 2.4 + 0.8 + 4.8, "sum of 3 rails"),
    ],
)
def test_the_total_is_never_added_to_its_parts(line, watts, boundary):
    found, where = total_power(parse_line(line).rails)
    assert found == pytest.approx(watts)
    assert where.startswith(boundary)


def test_what_else_a_line_says():
    nano, orin, agx = parse_line(NANO_4), parse_line(ORIN_5.format(second=1, mw=1)), parse_line(AGX_ORIN_6)
    assert nano.cpu_load == (12, 8, None, 3)
    assert (nano.gpu_load, nano.gpu_mhz, nano.ram_mb) == (25, (614,), 1811)
    assert nano.temperature_c["PLL"] == 33.5
    assert orin.temperature_c["CV0"] == -256
    assert orin.time is not None
    assert (agx.gpu_load, agx.gpu_mhz) == (0, (1300, 1300))
    assert "NC" not in agx.rails
    assert "NEW_TOKEN" not in agx.rails
    assert nano.time is None
    assert parse_line("99-99-2024 08:15:01 VDD_IN 1mW/1mW").time is None


@given(st.text(max_size=300))
def test_any_text_is_parsed(text):
    parse_line(text)


@given(st.data())
def test_lines_with_anything_between_keep_their_rails(data):
    """Tokens of tools to come stand between those of today."""
    words = NANO_4.split(" POM_5V_IN")[0].split(" ")
    junk = data.draw(st.lists(st.from_regex(r"[A-Z]{2,6}_?[0-9]?@?\[?[0-9]{0,3}\]?", fullmatch=True), max_size=6))
    for word in junk:
        words.insert(data.draw(st.integers(0, 2)), word)
    rails = parse_line(" ".join([*words, "POM_5V_IN 3120/2950", *junk])).rails
    assert rails["POM_5V_IN"] == 3.12


# -------------------------------------------------------------------------------------------------------------- logs


def orin_log(tmp_path, milliwatts, extra=()):
    lines = [ORIN_5.format(second=k, mw=mw) for k, mw in enumerate(milliwatts)]
    path = tmp_path / "tegra.log"
    path.write_text("\n".join([*lines, *extra]) + "\n", encoding="utf-8")
    return path


def test_a_log_with_time_stamps(tmp_path):
    found = read_log(orin_log(tmp_path, [4000, 4200] * 15))
    assert found.mean_w == pytest.approx(4.1)
    assert found.seconds == pytest.approx(30.0)
    assert found.rails["VDD_SOC"] == pytest.approx(1.23)
    low, high = found.figure().low, found.figure().high
    assert low <= 4.1 <= high


def test_lines_without_power_and_other_rails_are_counted_not_used(tmp_path):
    path = orin_log(tmp_path, [4000] * 12, extra=["tegrastats: stopped", "VDD_IN 90000mW/1mW", ""])
    found = read_log(path)
    assert (found.skipped, len(found.watts)) == (2, 12)
    assert found.mean_w == pytest.approx(4.0)


def test_a_log_without_time_stamps_takes_the_interval(tmp_path):
    path = tmp_path / "nano.log"
    path.write_text("\n".join([NANO_4] * 24), encoding="utf-8")
    assert read_log(path, 0.5).seconds == 12.0
    assert read_log(path).seconds == 24.0
    with pytest.raises(MeasureError, match=r"2.4 s, expected at least 10 s"):
        read_log(path, 0.1).figure()


def test_logs_that_say_nothing(tmp_path):
    path = tmp_path / "x.log"
    path.write_text("RAM 1/2MB\nhello\n", encoding="utf-8")
    with pytest.raises(MeasureError, match="no power rail in any of 2 lines"):
        read_log(path)
    path.write_bytes(bytes(range(256)) * 20)
    with pytest.raises(MeasureError, match="no power rail"):
        read_log(path)
    with pytest.raises(OSError, match="No such file"):
        read_log(tmp_path / "none.log")


def test_the_live_tool(tmp_path, monkeypatch):
    """A stand-in that prints ten lines a second as asked."""
    tool = tmp_path / "tegrastats"
    tool.write_text(f"#!/bin/sh\n[ \"$1\" = --interval ] || exit 3\nwhile true; do echo '{NANO_4}'; done\n")
    tool.chmod(tool.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    found = record_live(12, 0.5)
    assert (len(found.watts), found.seconds) == (24, 12.0)
    assert found.mean_w == pytest.approx(3.12)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(MeasureError, match="tegrastats is not on this machine"):
        record_live(12)


# ------------------------------------------------------------------------------------------------------------- sysfs


def write(folder, **files):
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(f"{text}\n")


def jetpack_5(root, milliamperes=800):
    folder = root / "sys/bus/i2c/devices/1-0040/hwmon/hwmon3"
    write(folder, name="ina3221", in1_label="VDD_IN", in1_input=5000, curr1_input=milliamperes,
          in2_label="VDD_CPU_GPU_CV", in2_input=5000, curr2_input=100, in3_label="NC", in3_input=0, curr3_input=0,
          in7_label="sum of shunt voltages", in7_input=9, curr4_input=7)  # fmt: skip
    write(root / "sys/bus/i2c/devices/0-004c/hwmon/hwmon0", name="tmp451", in1_label="VDD_IN", in1_input=9,
          curr1_input=9)  # fmt: skip


def test_rails_of_jetpack_5(tmp_path):
    jetpack_5(tmp_path)
    assert read_rails(tmp_path) == pytest.approx({"VDD_IN": 4.0, "VDD_CPU_GPU_CV": 0.5})
    (sensor,) = find_sensors(tmp_path)
    assert (sensor.name, sensor.boundary) == ("ina3221", "input rail VDD_IN, which holds all others")


def test_rails_of_jetpack_4(tmp_path):
    folder = tmp_path / "sys/bus/i2c/drivers/ina3221x/6-0040/iio:device0"
    write(folder, rail_name_0="POM_5V_IN", in_power0_input=1750, rail_name_1="POM_5V_GPU", in_power1_input=40,
          rail_name_2="POM_5V_CPU", in_power2_input="garbage")  # fmt: skip
    assert read_rails(tmp_path) == pytest.approx({"POM_5V_IN": 1.75, "POM_5V_GPU": 0.04})


def rapl(root, number, name, microjoules, limit=1000_000_000):
    write(root / f"sys/class/powercap/intel-rapl:{number}", name=name, energy_uj=microjoules,
          max_energy_range_uj=limit)  # fmt: skip


def test_rapl_packages_or_the_platform_never_both(tmp_path):
    rapl(tmp_path, "0", "package-0", 5)
    rapl(tmp_path, "0:0", "core", 4)
    rapl(tmp_path, "1", "package-1", 5)
    assert [d.name for d in rapl_domains(tmp_path)] == ["package-0", "package-1"]
    rapl(tmp_path, "2", "psys", 50)
    assert [d.name for d in rapl_domains(tmp_path)] == ["psys"]


@given(st.integers(0, 999_999_999), st.integers(0, 99_000_000))
def test_a_counter_that_wraps(tmp_path_factory, before, used):
    root = tmp_path_factory.mktemp("rapl")
    rapl(root, "0", "package-0", (before + used) % 1_000_000_000)
    (domain,) = rapl_domains(root)
    assert rapl_energy_j(domain, before * 1e-6)[1] == pytest.approx(used * 1e-6, abs=2e-6)


class World:
    """Time that passes only while somebody sleeps, and what happens then."""

    def __init__(self, then):
        self.now, self.then = 0.0, then

    def sleep(self, seconds):
        self.now += seconds
        self.then(self.now)

    def clock(self):
        return self.now


def test_recording_rails(tmp_path):
    world = World(lambda now: jetpack_5(tmp_path, 800 if now < 6.2 else 1000))
    jetpack_5(tmp_path)
    found = record(12, root=tmp_path, sleep=world.sleep, clock=world.clock)
    assert found.seconds == pytest.approx(12)
    assert found.mean_w == pytest.approx((12 * 4 + 12 * 5) / 24)


def test_recording_rapl(tmp_path):
    """7 W for 15 s, over a wrap of the counter at 50 J."""

    def spend(now):
        rapl(tmp_path, "0", "package-0", round(7e6 * now) % 50_000_000, 50_000_000)

    world = World(spend)
    spend(0.0)
    found = record(15, root=tmp_path, sleep=world.sleep, clock=world.clock)
    assert found.watts == pytest.approx([7.0] * 30)
    assert found.boundary == "processor package x 1 (RAPL)"


def test_no_sensor_no_number(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    assert find_sensors(tmp_path) == []
    with pytest.raises(MeasureError, match="no INA3221, no RAPL, no tegrastats"):
        record(10, root=tmp_path)
    (tmp_path / "sys/class/powercap/intel-rapl:0").mkdir(parents=True)
    assert "for root alone" in no_sensor(tmp_path)


# ------------------------------------------------------------------------------------------------------------- rules


def recording(watts, seconds=20.0, boundary="board"):
    return Recording(tuple(watts), seconds, boundary, "test", {})


def test_idle_is_subtracted_only_at_the_same_boundary():
    load, idle = recording([5.0, 5.1] * 20), recording([3.0, 3.1] * 20)
    assert increment(load, idle).get("W") == pytest.approx(2.0)
    with pytest.raises(MeasureError, match="cannot be subtracted"):
        increment(load, recording([3.0, 3.1], boundary="wall"))
    with pytest.raises(MeasureError, match="5 s, expected at least 10 s"):
        increment(load, recording([3.0, 3.1], seconds=5))


@given(st.lists(st.floats(0, 100, allow_subnormal=False), min_size=2, max_size=60))
def test_intervals_hold_the_mean(watts):
    figure = recording(watts).figure()
    assert figure.low <= figure.value <= figure.high
    assert figure.low >= 0


def test_recordings_that_cannot_be():
    with pytest.raises(MeasureError, match="no power was read"):
        recording([])
    for bad in (-1.0, math.nan, math.inf):
        with pytest.raises(MeasureError, match="below 0 or not finite"):
            recording([1.0, bad])
    with pytest.raises(MeasureError, match="one sample"):
        recording([1.0]).figure()
    with pytest.raises(MeasureError, match="no rails"):
        total_power({})
