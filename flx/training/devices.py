"""The devices of a training: the state lies on each of them, and each works on its own rows of every batch.

XLA adds up the gradients (data parallelism by `jax.sharding`); the step is written as for one device.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental.multihost_utils import broadcast_one_to_all
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from flx.training.hosts import Host

ROWS = "rows"  # of a batch: copies of the mesh


class Devices(NamedTuple):
    """Some devices of each process, in the order of the processes."""

    mesh: Mesh
    host: Host = Host()

    def __str__(self) -> str:
        kind = self.mesh.devices.flat[0].device_kind
        among = f" of {self.host.count} processes" if self.host.count > 1 else ""
        return f"{self.count} devices ({kind}){among}"

    @property
    def count(self) -> int:
        """The devices of all processes."""
        return self.mesh.size

    def rows(self, batch: int) -> slice:
        """The rows of a batch that this process makes."""
        share = batch // self.host.count
        return slice(self.host.number * share, (self.host.number + 1) * share)

    @property
    def rules(self) -> dict[str, Any]:
        """Options of `jax.jit` for a function whose results lie on every device."""
        return {} if self.count == 1 else {"out_shardings": NamedSharding(self.mesh, PartitionSpec())}

    def here(self, tree: Any) -> Any:
        """What lies on every device, as arrays of this process."""
        return tree if self.count == 1 else jax.tree.map(lambda a: a.addressable_data(0), tree)

    def each_says(self, number: int) -> Any:
        """A number of this process for each of its devices."""
        return self.spread(np.full(self.count // self.host.count, number, np.int32))

    def spread(self, rows: Any) -> Any:
        """A batch over all devices, of which this process gives its rows; arrays, leading axis first."""
        if self.count == 1:
            return jax.device_put(rows, self.mesh.devices[0])
        sharding = NamedSharding(self.mesh, PartitionSpec(ROWS))
        return jax.tree.map(lambda a: jax.make_array_from_process_local_data(sharding, a), rows)

    def on_each(self, tree: Any) -> Any:
        """Arrays on every device, as the leading process has them."""
        if self.count == 1:
            return jax.device_put(tree, self.mesh.devices[0])
        if self.host.count > 1:
            tree = broadcast_one_to_all(tree)
        sharding = NamedSharding(self.mesh, PartitionSpec())
        each = jax.tree.map(np.asarray, tree)
        return jax.tree.map(lambda a: jax.make_array_from_callback(a.shape, sharding, lambda at: a[at]), each)


def devices_for(batch: int, parts: int = 1, wanted: int | None = None, host: Host | None = None) -> Devices:
    """As many devices of each process as can share a batch, or as many as wanted.

    Args:
        batch: Rows of a batch.
        parts: How many parts of it are worked on one after the other.
        wanted: Devices of each process; the most that the rows of a part can be shared among, unless given.
        host: This process among those of the training.

    Raises ValueError where a process has fewer devices than wanted, or the rows cannot be shared evenly.
    """
    host = host or Host()
    there, rows = jax.local_device_count(), batch // parts
    if wanted is not None and wanted > there:
        raise ValueError(
            f"--devices is {wanted}, but there are {there} ({jax.default_backend()}); give at most that"
        )
    if rows % (sharing := host.count * (wanted or 1)):
        raise ValueError(
            f"train.batch is {batch}{f', in {parts} parts' * (parts > 1)}, which {sharing} devices cannot "
            f"share; make it a multiple of {sharing * parts}"
        )
    share = rows // host.count
    number = wanted or max(n for n in range(1, there + 1) if share % n == 0)
    chosen = [
        device
        for process in range(host.count)
        for device in [d for d in jax.devices() if d.process_index == process][:number]
    ]
    return Devices(Mesh(np.array(chosen), (ROWS,), axis_types=(AxisType.Auto,)), host)
