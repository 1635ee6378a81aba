"""Recorded breaths: exploring, cutting, dividing, and the public file format."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, once, user_error

from delucax import lung


pytestmark = once

KEY = jax.random.key(0)


def task(resistance):
    """With the sensor of the double compartment."""
    options = dict(sensor_delay=2, noise=0.2, solver=diffrax.Euler())
    return lung.single_compartment(resistance=resistance, **options)


@pytest.fixture(scope="module")
def breaths():
    env = task(5.0)
    lungs = dict(resistance=5.0, compliance=20.0)
    return lung.explore(env, 12, key=KEY, length=40, scale=0.5, **lungs)


def test_explored_breaths(breaths):
    assert len(breaths) == 12 and breaths.pressure.shape == (12, 40)
    assert np.all(breaths.truth <= 70) and np.all(breaths.u_in >= 0)
    assert np.all(breaths.u_in <= 100) and np.std(breaths.u_in) > 5
    # 1 s of inspiration; the noise of the sensor; two samples until it shows anything.
    assert_close(breaths.u_out, np.tile(np.arange(40) * 0.03 > 1, (12, 1)))
    noise = breaths.pressure - breaths.truth
    assert 0.17 < np.std(noise) < 0.23 and abs(np.mean(noise)) < 0.05
    assert_close(breaths.truth[:, :3], 5.0, rtol=1e-6)
    with user_error(match="hardly|some breaths stay below"):
        same = dict(key=KEY, length=40, scale=0.5)  # compiled before
        lung.explore(task(20.0), 12, abort=5.1, **same)


def test_segments_are_inspirations():
    rng = np.random.default_rng(0)
    lengths = [(10, 30), (33, 20), (29, 5), (28, 5)]
    u_out = np.concatenate([[1.0] * 3] + [[0.0] * a + [1.0] * b for a, b in lengths])
    pressure = rng.normal(size=u_out.size)
    found = lung.Breaths.from_recording(0 * u_out, u_out, pressure, dt=0.03)
    assert found.pressure.shape == (2, 29) and np.all(found.u_out == 0)
    assert_close(found.pressure[0], pressure[43:72], rtol=1e-6)
    assert_close(found.pressure[1], pressure[96:125], rtol=1e-6)
    with user_error(match="longest inspiration of 4 has 33"):
        lung.Breaths.from_recording(0 * u_out, u_out, pressure, dt=0.03, length=40)
    with user_error(match="must be vectors of one size"):
        lung.Breaths.from_recording(u_out[1:], u_out, pressure, dt=0.03)


def test_split(breaths):
    train, test = breaths.split(0.25, key=KEY)
    assert (len(train), len(test)) == (9, 3)
    rows = jnp.concatenate([train.pressure, test.pressure])
    assert_close(jnp.sort(rows[:, 5]), jnp.sort(breaths.pressure[:, 5]))
    with user_error(match="must leave breaths on both sides"):
        breaths.split(0.01, key=KEY)


def test_breaths_of_wrong_shapes():
    zeros = jnp.zeros((2, 5))
    with user_error(match="u_out must have shape .2, 5. like pressure"):
        lung.Breaths(zeros, zeros[:1], zeros, dt=0.03)
    with user_error(match="resistance must have shape .2,., an entry for each"):
        lung.Breaths(zeros, zeros, zeros, dt=0.03, resistance=jnp.ones(3))


@pytest.fixture(scope="module")
def lines(breaths, tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "train.csv"
    lung.write_breaths(path, breaths)
    return path.read_text().splitlines()


def test_file_comes_back(breaths, lines, tmp_path):
    path = tmp_path / "train.csv"
    path.write_text("\n".join(lines) + "\n")
    again = lung.read_breaths(path)
    assert again.pressure.shape == (12, 29)
    assert_close(again.pressure, breaths.pressure[:, :29], atol=1e-5)
    assert_close(again.u_in, breaths.u_in[:, :29], atol=1e-5)
    assert_close(again.resistance, 5.0)
    assert_close(again.dt, 0.03, rtol=1e-5)
    # Samples of another rate: the pressure along a line, the control held.
    half = lung.read_breaths(path, dt=0.015, length=57)
    assert_close(half.pressure[:, ::2], again.pressure, atol=1e-4)
    assert_close(half.u_in[:, 1::2], again.u_in[:, :28], atol=1e-4)


def test_rounded_times_hold_the_control_of_their_step(tmp_path):
    u = jnp.tile(jnp.arange(29.0), (2, 1))
    lungs = dict(resistance=jnp.full(2, 5.0), compliance=jnp.full(2, 10.0))
    path = tmp_path / "train.csv"
    lung.write_breaths(path, lung.Breaths(u, 0 * u, 5 + u, dt=1 / 30, **lungs))
    assert_close(lung.read_breaths(path).u_in, u)


def test_lungs_of_other_values(lines, tmp_path):
    path = tmp_path / "train.csv"
    header, *rows = lines
    path.write_text("\n".join([header, *(r.replace(",5,20,", ",7,30,") for r in rows)]))
    again = lung.read_breaths(path, resistances=(7.0,), compliances=(30.0, 40.0))
    assert_close(again.resistance, 7.0)
    assert_close(again.compliance, 30.0)
    with user_error(match="column C: must be one of 10, 20, 50, got 30"):
        lung.read_breaths(path, resistances=(7.0,))


def test_quoted_numbers_and_blank_lines(lines, tmp_path):
    path, plain = tmp_path / "quoted.csv", tmp_path / "plain.csv"
    plain.write_text("\n".join(lines))
    quoted = [",".join(f'"{cell}"' for cell in line.split(",")) for line in lines]
    quoted = [*quoted[:50], "", *quoted[50:], ""]
    path.write_bytes("\r\n".join(quoted).encode("utf-8-sig"))
    found, expected = lung.read_breaths(path), lung.read_breaths(plain)
    assert_close(found.pressure, expected.pressure)
    assert_close(found.u_in, expected.u_in)


def test_a_column_is_there_once(lines, tmp_path):
    path = tmp_path / "twice.csv"
    path.write_text("\n".join([f"{lines[0]},R", *(f"{line},20" for line in lines[1:])]))
    with user_error(match="must have each column once, but repeats R"):
        lung.read_breaths(path)


def edited(lines, row, column, text):
    header = lines[0].split(",")
    cells = lines[row - 1].split(",")
    cells[header.index(column)] = text
    return [*lines[: row - 1], ",".join(cells), *lines[row:]]


def without(lines, name):
    place = lines[0].split(",").index(name)
    drop = lambda line: ",".join(  # noqa: E731
        cell for i, cell in enumerate(line.split(",")) if i != place
    )
    return [drop(line) for line in lines]


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda s: without(s, "u_out"), "row 1: column u_out is missing"),
        (lambda s: edited(s, 7, "pressure", ""), "row 7, column pressure: .* finite"),
        (lambda s: edited(s, 8, "u_in", "nan"), "row 8, column u_in: .* got 'nan'"),
        (lambda s: edited(s, 3, "R", "7"), "row 3, column R: must be one of 5, 20, 50"),
        (lambda s: edited(s, 3, "C", "20.5"), "row 3, column C: must be one of 10"),
        (lambda s: edited(s, 4, "C", "50"), "row 4, column C: must be the same for"),
        (lambda s: edited(s, 5, "time_step", "0"), "row 5, column time_step: must inc"),
        (lambda s: edited(s, 5, "u_out", "1"), "row 2, column u_out: .* too short"),
        (lambda s: [*s, *s[1:41]], "row 482, column breath_id: .* follow each other"),
        (
            lambda s: edited([*s, *s[1:2]], 482, "breath_id", "99"),
            "row 482, .* got 1 of breath 99",
        ),
        (lambda s: edited(s, 7, "u_in", "500"), "row 7, column u_in: .* 100, got 500"),
        (lambda s: edited(s, 7, "u_in", "-20"), "row 7, column u_in: .* 0 and 100"),
        (lambda s: edited(s, 9, "u_out", "2"), "row 9, column u_out: .* one of 0, 1"),
        (lambda s: edited(s, 9, "time_step", "nan"), "row 9, column time_step: .* fin"),
        (lambda s: edited(s, 9, "id", "#9"), "row 9, column id: .* got '#9'"),
        (lambda s: [*s, "# the end"], "row 482, column id: .* got '# the end'"),
        (lambda s: edited(s, 9, "R", "2_0"), "row 9, column R: .* got '2_0'"),
        # A blank line is passed over, and is a line of the file all the same.
        (lambda s: edited([*s[:3], "", *s[3:]], 8, "R", "7"), "row 8, column R"),
        (lambda s: edited([*s[:3], "", *s[3:]], 8, "R", "x"), "row 8, column R"),
        (lambda s: s[:1], "must have rows"),
        (lambda s: [*s[:1], "", ""], "must have rows"),
        (lambda s: [], "row 1: column id, breath_id"),
    ],
)
def test_wrong_files_are_named(lines, change, message, tmp_path):
    path = tmp_path / "train.csv"
    path.write_text("\n".join(change(lines)) + "\n")
    with user_error(match=message):
        lung.read_breaths(path)
