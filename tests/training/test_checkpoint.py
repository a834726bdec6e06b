"""Laws of checkpoints: what comes back is what went in, and a kill during a save costs only that save."""

import signal
import subprocess
import sys
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from flx.training.checkpoint import Checkpoints


class State(NamedTuple):
    step: Any
    params: Any
    optimizer: Any


def state_of(seed: int) -> State:
    keys = jax.random.split(jax.random.key(seed))
    params = {"w": jax.random.normal(keys[0], (5, 3)), "b": [jax.random.normal(keys[1], (3,), jnp.bfloat16)]}
    return State(jnp.int32(seed), params, optax.chain(optax.clip(1.0), optax.adam(1e-3)).init(params))


def assert_same(a: Any, b: Any):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    leaves = list(zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    assert len(leaves) >= 8
    for x, y in leaves:
        assert x.dtype == y.dtype and x.shape == y.shape
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


def test_the_newest_state_comes_back_bit_for_bit_on_the_host(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for step in (1, 5, 9):
        checkpoints.save(step, state_of(step))
    restored = Checkpoints(tmp_path).restore_latest(jax.eval_shape(lambda: state_of(0)))
    assert restored is not None
    step, state = restored
    assert step == 9 and all(isinstance(x, np.ndarray) for x in jax.tree.leaves(state))
    assert_same(state, state_of(9))
    assert not np.array_equal(state.params["w"], state_of(5).params["w"])


def test_the_two_newest_are_kept(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for step in (1, 2, 3):
        checkpoints.save(step, state_of(step))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["2", "3"]


def test_a_saved_state_may_be_donated_at_once(tmp_path):
    overwrite = jax.jit(lambda s: jax.tree.map(lambda x: x * 0 - 1, s), donate_argnums=0)
    big = {"w": jnp.arange(3_000_000, dtype=jnp.float32)}
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, big)
    jax.block_until_ready(overwrite(big))
    assert big["w"].is_deleted()
    restored = checkpoints.restore_latest({"w": jax.ShapeDtypeStruct((3_000_000,), jnp.float32)})
    assert restored is not None
    np.testing.assert_array_equal(restored[1]["w"], np.arange(3_000_000, dtype=np.float32))


def test_no_checkpoint_is_none_and_a_reader_makes_nothing(tmp_path):
    checkpoints = Checkpoints(tmp_path / "none")
    assert checkpoints.restore_latest(state_of(0)) is None and checkpoints.latest_step is None
    assert not (tmp_path / "none").exists()


def flipped(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


@pytest.mark.parametrize("damage", [flipped, lambda c: c[: len(c) // 2], lambda c: b""])
def test_the_checkpoint_before_a_damaged_one_is_restored_and_said(tmp_path, capsys, damage):
    checkpoints = Checkpoints(tmp_path)
    for step in (30, 40):
        checkpoints.save(step, state_of(step))
    (tmp_path / "45").mkdir()  # empty
    (tmp_path / "50").write_bytes(b"")  # a file is none
    path = tmp_path / "40"
    for file in [file for file in (path / "default" / "d").rglob("*") if file.is_file()]:  # the numbers
        file.write_bytes(damage(file.read_bytes()))
    restored = checkpoints.restore_latest(state_of(0))
    assert restored is not None and restored[0] == 30
    assert_same(restored[1], state_of(30))
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"{path} is damaged (" in said and "goes on from step 30" in said
    checkpoints.save(35, state_of(35))  # the damaged one was ahead, and will never be the newest again
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_dir()) == ["30", "35", "45"]


def test_where_all_are_damaged_that_is_the_reason_given(tmp_path):
    for step in (30, 40):
        Checkpoints(tmp_path).save(step, state_of(step))
        (tmp_path / f"{step}" / "digest").write_text("another")
    with pytest.raises(ValueError, match=r"40 is damaged .*, and none is before it") as error:
        Checkpoints(tmp_path).restore_latest(state_of(0))
    assert "\n" not in str(error.value) and "network" not in str(error.value)


@pytest.mark.parametrize(
    "params, told",
    [
        (
            {"w": np.ones((5, 4), np.float32), "b": [np.ones(3, jnp.bfloat16)]},
            r"\['w'\] has shape \(5, 3\), not \(5, 4\)",
        ),
        ({"v": np.ones((5, 3), np.float32)}, "have other names"),
        (state_of(1).params | {"size": np.ones(3, np.float32)}, "have other names"),
        ({"w": np.ones((5, 3)), "b": [np.ones(3, jnp.bfloat16)]}, r"\['w'\] is float32, not float64"),
    ],
)
def test_another_network_is_refused(tmp_path, params, told):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state_of(1))
    with pytest.raises(ValueError, match=told) as error:
        checkpoints.restore_latest(state_of(1)._replace(params=params))
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_kill_during_a_save_leaves_the_one_before_and_its_rest_is_cleared(tmp_path):
    """Save step 1, begin step 2 with 200 MB, kill -9 as soon as its torn file is there."""
    save = (
        "import sys; from pathlib import Path; import numpy as np\n"
        "from flx.training.checkpoint import Checkpoints\n"
        "c = Checkpoints(Path(sys.argv[1]))\n"
        "c.save(1, {'w': np.ones(25_000_000)}); c.save(2, {'w': np.random.default_rng(0).random(25_000_000)})"
    )
    child = subprocess.Popen([sys.executable, "-c", save, str(tmp_path)])
    while child.poll() is None and not list(tmp_path.glob(".flx-*.2")):
        time.sleep(0.001)
    child.kill()
    assert child.wait() == -signal.SIGKILL and list(tmp_path.glob(".flx-*"))
    checkpoints = Checkpoints(tmp_path)
    restored = checkpoints.restore_latest({"w": jax.ShapeDtypeStruct((25_000_000,), np.float64)})
    assert restored is not None and restored[0] == 1 and (restored[1]["w"] == 1).all()
    checkpoints.save(4, {"w": np.ones(1)})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["1", "4"]
