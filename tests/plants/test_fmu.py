"""A lung written as an FMU and read again answers as the simulator; none is run unasked."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest

from ventbench import load_simulators, open_loop, simulate
from ventbench.base.errors import InputError
from ventbench.cli.options import simulator_of

pytest.importorskip("pythonfmu3", reason="needs the extra fmu")
fmpy = pytest.importorskip("fmpy", reason="needs the extra fmu")

from ventbench.plants.fmu import Fmu, export  # noqa: E402
from ventbench.simulation import Controls  # noqa: E402


@pytest.fixture(scope="module")
def lung(tmp_path_factory):
    path = tmp_path_factory.mktemp("fmu") / "R20C50.fmu"
    return export(load_simulators("frozen").plant("R20C50"), path, lung="R20C50")


def controls() -> Controls:
    rng, count = np.random.default_rng(0), 60
    time = np.cumsum(rng.uniform(0.01, 0.05, count))
    u_out = (np.arange(count) >= 35).astype(float)
    return Controls(time, rng.uniform(0.0, 60.0, count), u_out)


def test_it_answers_as_the_simulator_does_at_any_step_and_breath_after_breath(lung):
    foreign, given = Fmu(lung), controls()
    for start in (5.0, 8.0, 5.0):
        wanted = simulate(given, lung="R20C50", simulator="frozen", start=start)
        found = simulate(given, lung="R20C50", simulator=foreign, start=start)
        np.testing.assert_allclose(found.pressure, wanted.pressure, rtol=0, atol=1e-9)
    assert found.pressure.max() > 20.0


def test_a_runner_of_others_runs_it(lung):
    """FMPy's own loop: inputs by table, outputs at equal steps."""
    steps, dt = 30, 0.03
    table = np.array([(0.0, 12.0, 0.0)], [("time", float), ("u_in", float), ("u_out", float)])
    outputs = ["pressure", "flow", "volume"]
    shown = fmpy.simulate_fmu(
        str(lung), stop_time=steps * dt, step_size=dt, output_interval=dt, input=table,
        output=outputs, start_values={"initial_pressure": 6.0},
    )  # fmt: skip
    u_in = np.full(steps + 1, 12.0)
    wanted = simulate(u_in, lung="R20C50", simulator="frozen", start=6.0).pressure
    np.testing.assert_allclose(shown["pressure"], wanted, rtol=0, atol=1e-9)
    assert np.all(np.diff(shown["volume"][3:]) > 0.0)
    assert shown["flow"][-1] > 0.0


def test_it_is_compared_with_recordings_and_its_file_is_named(lung):
    import ventbench

    recorded = ventbench.load_recording(ventbench.example("concealed"))[:3]
    report, ours = open_loop(recorded, Fmu(lung)), open_loop(recorded, load_simulators("frozen"))
    assert report.plant == "R20C50.fmu"
    assert report.about is not None
    assert report.about["sha256"] == Fmu(lung).sha256
    mae = [each.lungs["R20C50"]["mae"] for each in (report, ours)]
    assert mae[0] == pytest.approx(mae[1], abs=2.0)


def test_nothing_runs_unasked(lung, tmp_path):
    with pytest.raises(InputError, match=r"machine code.*--in-process"):
        load_simulators(lung)
    assert simulator_of(str(lung), False) == str(lung)
    trusted = simulator_of(str(lung), True)
    assert isinstance(trusted, Fmu)
    assert load_simulators(trusted).kind == "function"
    with pytest.raises(InputError, match="cannot run in a closed loop"):
        _ = load_simulators(trusted).stacked


def test_what_is_wrong_is_said(lung, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        Fmu(tmp_path / "none.fmu")
    (tmp_path / "text.fmu").write_text("no archive")
    with pytest.raises(InputError, match="not a zip archive"):
        Fmu(tmp_path / "text.fmu")
    with zipfile.ZipFile(tmp_path / "empty.fmu", "w") as archive:
        archive.writestr("a", "b")
    with pytest.raises(InputError, match="not an FMU"):
        Fmu(tmp_path / "empty.fmu")
    with pytest.raises(InputError, match=r"no variable p_aw; it has .*pressure"):
        Fmu(lung, {"pressure": "p_aw"})
    with pytest.raises(InputError, match=r"ends in \.fmu"):
        export(load_simulators("physics").plant("R5C10"), tmp_path / "a.zip", lung="R5C10")
    without = tmp_path / "without.fmu"
    with zipfile.ZipFile(lung) as old, zipfile.ZipFile(without, "w") as new:
        for name in old.namelist():
            if not name.startswith("binaries"):
                new.writestr(name, old.read(name))
    with pytest.raises(InputError, match=r"cannot be started|has no binary"):
        Fmu(without).reset(5.0, 20.0, 50.0)
