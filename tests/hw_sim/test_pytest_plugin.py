"""The plugin as its users meet it: the example of the documentation, and a test that fails."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]
DOCS = Path(__file__).resolve().parents[2] / "docs" / "hil.md"


def run(pytester: pytest.Pytester, text: str) -> pytest.RunResult:
    pytester.makepyfile(text)
    return pytester.runpytest_subprocess("-p", "upbeam.hw_sim.pytest_plugin", "-W", "error", "--strict-markers")


def test_the_documented_example_runs(pytester: pytest.Pytester) -> None:
    example = re.search(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    assert example is not None
    lines = example[1].strip().splitlines()
    assert len(lines) <= 10
    run(pytester, example[1]).assert_outcomes(passed=1)


def test_a_failure_shows_the_transcript(pytester: pytest.Pytester) -> None:
    result = run(
        pytester,
        """
        def test_it(dut, faults, clock):
            clock.run(0.3)
            faults.start("silence")
            clock.run(0.2)
            assert not dut.faults
        """,
    )
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*upbeam transcript*", "*bench*silence*", "*fault_set SENSOR_TIMEOUT*"])


def test_every_fixture(pytester: pytest.Pytester) -> None:
    result = run(
        pytester,
        """
        import pytest
        from upbeam.hw_sim.can.commander import Commander

        @pytest.mark.upbeam(sensor={"model": "hdl-32e", "rate_hz": 10.0}, dut={"deadline_ns": 40_000_000})
        def test_settings(sensor, dut, clock):
            assert sensor.config.model == "hdl-32e"
            clock.run(0.35)
            assert clock.now == pytest.approx(0.35)
            assert len(dut.ledger) == 3
            assert dut.mode == "network"

        def test_commands(dut, clock, can_bus, serial_port):
            clock.run(0.2)
            dut.command("mode", mode="REPEAT")
            clock.run(0.1)
            assert dut.mode == "repeat"
            dut.command("mode", via="serial", mode="AUTOMATIC")
            clock.run(0.1)
            assert dut.mode == "network"
            assert dut.status["commands_accepted"] == 2
            assert any(frame.identifier == 0x301 for frame in serial_port.received)
            assert can_bus.recv(0.1).arbitration_id >= 0x210

        def test_power(dut, clock):
            clock.run(0.2)
            dut.power_cycle(0.03)
            clock.run(0.3)
            assert len(dut.record.boots) == 2
            assert [event.kind for event in dut.events].count("stream_made") == 2

        def test_faults(dut, faults, clock):
            clock.run(0.4)
            faults.start("rpm", scale=0.9)
            faults.start("bit_flip", region="config")
            clock.run(0.4)
            faults.stop("rpm")
            assert any(event.fault == "COMPUTE_INTEGRITY" for event in dut.events)
            with pytest.raises(ValueError, match="was not begun"):
                faults.stop("loss")
            with pytest.raises(ValueError, match="expected one of"):
                faults.start("nothing")
            with pytest.raises(TimeoutError, match="virtual time"):
                clock.run_until(lambda: False, timeout=0.05)
        """,
    )
    result.assert_outcomes(passed=4)
