"""Several processes that train one run together, one for each machine, joined by JAX's distributed runtime.

Process 0 leads: it alone writes into the run's folder. Beside JAX's own connections each process keeps one
to the leader. It closes as soon as a process dies, however it dies, and then the others end too, in one line;
JAX alone would notice after minutes.
"""

import contextlib
import os
import re
import selectors
import socket
import sys
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np
from jax.experimental.multihost_utils import broadcast_one_to_all, sync_global_devices
from orbax.checkpoint.multihost import sync_global_processes

from flx.stopping import end_at_once

GIVEN = re.compile(r"(?P<number>\d+)/(?P<count>\d+)@(?P<address>[^:/@\s]+):(?P<port>\d+)")
PATIENCE = 300  # seconds until all processes must have started
DAY = 86_400  # seconds for the leader to prepare what the others wait for
NEWS = 10.0  # seconds until the death of another process has been noticed
FAREWELL = b"."
ALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 4}  # a machine that vanished: 30 seconds


class Host(NamedTuple):
    """This process among those of a training."""

    number: int = 0
    count: int = 1

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes."""
        return self.number == 0


@contextlib.contextmanager
def joined(hosts: str | None) -> Iterator[Host]:
    """Join the other processes of a training, before anything is computed; alone without `hosts`.

    Args:
        hosts: "NUMBER/COUNT@ADDRESS:PORT", such as 0/2@10.0.0.1:1234: which process this is, how many there
            are, and where process 0 is reached; "auto" where Slurm, Open MPI, Kubernetes or a TPU pod tells.

    Raises ValueError for other words, and where the processes do not find each other.
    """
    if hosts is None:
        yield Host()
        return
    address = _join(hosts)
    host = Host(jax.process_index(), jax.process_count())
    with _connections(host, address) as connections, _watched(host, connections):
        yield host


@contextlib.contextmanager
def leader_first(host: Host, place: str) -> Iterator[None]:
    """What the leader writes inside is there when the others come in. Each place is passed once."""
    everybody = {*range(host.count)}
    if not host.leads:
        sync_global_processes(place, timeout=DAY, processes=everybody)
    yield
    if host.leads:
        sync_global_processes(place, timeout=DAY, processes=everybody)


def _join(hosts: str) -> str:
    """Join them by JAX; returns where other machines reach this one, if it is process 0."""
    given = GIVEN.fullmatch(hosts)
    if hosts != "auto" and (given is None or int(given["number"]) >= int(given["count"])):
        raise ValueError(
            f"--hosts is {hosts}; give NUMBER/COUNT@ADDRESS:PORT, such as 0/2@10.0.0.1:1234 for the first of "
            "two, or auto under Slurm, Open MPI, Kubernetes or on a TPU pod"
        )
    # Without it, the death of one process ends the others with a stack trace, and who ends waits for all.
    jax.config.update("jax_enable_recoverability", True)
    jax.config.update("jax_enable_preemption_service", False)  # it would take SIGTERM for itself
    where = {}
    if given:
        where = {
            "coordinator_address": f"{given['address']}:{given['port']}",
            "num_processes": int(given["count"]),
            "process_id": int(given["number"]),
        }
    try:
        jax.distributed.initialize(**where, initialization_timeout=PATIENCE)
        with _stdout_on_stderr():  # the first exchange says so there
            sync_global_devices("joined")
    except (RuntimeError, ValueError) as error:
        if "before any JAX calls" in str(error):
            raise ValueError("hosts come before anything is computed; begin a new Python process") from None
        raise ValueError(
            f"the processes of --hosts {hosts} did not find each other ({str(error).splitlines()[0]}); start "
            f"all of them within {PATIENCE} seconds, with the address of process 0"
        ) from None
    return given["address"] if given else socket.getfqdn()


@contextlib.contextmanager
def _stdout_on_stderr() -> Iterator[None]:
    """Lines that libraries print on stdout, which is for results, go to stderr."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


@contextlib.contextmanager
def _connections(host: Host, address: str) -> Iterator[dict[int, socket.socket]]:
    """The leader's connections to the others, by their number, or another one's to the leader."""
    with contextlib.ExitStack() as opened:
        listener = opened.enter_context(socket.create_server(("", 0))) if host.leads else None
        said = f"{address}:{listener.getsockname()[1]}" if listener else ""
        spelt = np.frombuffer(said.encode().ljust(256), np.uint8)
        address, _, port = bytes(broadcast_one_to_all(spelt)).decode().strip().rpartition(":")
        found = {}
        if listener:
            listener.settimeout(NEWS)
            with contextlib.suppress(TimeoutError):  # who is not there is not watched
                while len(found) < host.count - 1:
                    peer = opened.enter_context(listener.accept()[0])
                    found[int.from_bytes(peer.recv(4), "big")] = peer
        else:
            with contextlib.suppress(OSError):
                peer = opened.enter_context(socket.create_connection((address, int(port)), NEWS))
                peer.sendall(host.number.to_bytes(4, "big"))
                found[0] = peer
        if len(found) < (host.count - 1 if host.leads else 1):
            print(f"process {host.number} cannot watch all others; JAX's own timeouts hold", file=sys.stderr)
        for peer in found.values():
            peer.settimeout(None)
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for option, value in ALIVE.items():
                if number := getattr(socket, option, None):  # not everywhere
                    peer.setsockopt(socket.IPPROTO_TCP, number, value)
        yield found


@contextlib.contextmanager
def _watched(host: Host, connections: dict[int, socket.socket]) -> Iterator[None]:
    """While open, this process ends, with one line, when another one has died.

    An exchange with a dead process may raise anything, or wait for ever: the thread that watches speaks
    first.
    """
    threading.Thread(target=_watch, args=(host, connections), name="hosts", daemon=True).start()
    try:
        yield
    except SystemExit:  # asked to stop, as all are
        _take_leave(connections)
        raise
    except Exception as error:
        if isinstance(error, RuntimeError) or "Gloo" in str(error):
            time.sleep(NEWS)  # if the reason is a death, this process ends here
        raise
    _take_leave(connections)


def _take_leave(connections: dict[int, socket.socket]) -> None:
    for peer in connections.values():
        with contextlib.suppress(OSError):
            peer.sendall(FAREWELL)


def _watch(host: Host, connections: dict[int, socket.socket]) -> None:
    with selectors.DefaultSelector() as selector:
        for number, peer in connections.items():
            selector.register(peer, selectors.EVENT_READ, number)
        while selector.get_map():
            for key, _ in selector.select():
                try:
                    said = connections[key.data].recv(1)
                except OSError:
                    said = b""
                if said == FAREWELL:
                    selector.unregister(key.fileobj)
                elif connections[key.data].fileno() < 0:  # closed on this side
                    return
                else:
                    who = f"process {key.data} of {host.count}" if host.leads else "another process"
                    end_at_once(f"{who} of this training has ended", 1)
