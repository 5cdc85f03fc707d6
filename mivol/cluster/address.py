"""Where the workers of a run are: processes of this machine, a Dask scheduler, or jobs of a batch system.

Conventions. ``--cluster`` takes ``local:N``, the address of a scheduler, or a TOML file. Workers execute what they receive, so
a connection beyond this machine needs TLS, and a local cluster uses TLS with temporary certificates: other users of the machine
could otherwise connect to its port.
"""

from __future__ import annotations

import ipaddress
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import msgspec

from mivol.config import Section
from mivol.errors import MivolError
from mivol.optim.strategy import setting
from mivol.schema import check_keys, explain_error

BATCH_SYSTEMS = {
    "slurm": "SLURMCluster", "pbs": "PBSCluster", "sge": "SGECluster", "lsf": "LSFCluster", "oar": "OARCluster",
    "htcondor": "HTCondorCluster", "moab": "MoabCluster",
}  # fmt: skip
"""Class of dask_jobqueue by the word of ``scheduler``."""

FORMS = "local:N (N processes of this machine), tcp://host:port or tls://host:port (a Dask scheduler), or a TOML file"


class Certificates(Section):
    """Files of TLS: the client proves who it is, and checks who answers."""

    ca: Annotated[str, setting("path", "certificate of the authority (.pem)", min_length=1)]
    cert: Annotated[str, setting("path", "certificate of this client (.pem)", min_length=1)]
    key: Annotated[str, setting("path", "private key of this client (.pem)", min_length=1)]


class ClusterSettings(Section):
    """A file for ``--cluster``: where the workers are."""

    scheduler: Annotated[
        Literal["local", "address", "slurm", "pbs", "sge", "lsf", "oar", "htcondor", "moab"],
        setting("1", "local processes, the scheduler at an address, or a batch system"),
    ]
    address: Annotated[str, setting("1", 'address of the scheduler, for scheduler = "address"')] = ""
    workers: Annotated[int, setting("worker", "workers to start; not for an address", ge=1)] = 2
    threads: Annotated[int, setting("thread", "threads of Dr.Jit in a worker; 0: the cores of the worker", ge=0)] = 0
    wait: Annotated[float, setting("s", "time to wait for the first worker; 0: until it comes", ge=0)] = 0.0
    security: Annotated[Certificates | None, setting("1", "TLS of an address beyond this machine")] = None
    job: Annotated[dict[str, Any], setting("1", "keywords of dask_jobqueue: queue, account, walltime, cores, memory")] = {}

    def __post_init__(self) -> None:
        if (self.scheduler == "address") != bool(self.address):
            raise ValueError('scheduler = "address" goes with an address, and no other scheduler has one')
        if self.job and self.scheduler not in BATCH_SYSTEMS:
            raise ValueError("the table [job] is for a batch system: remove it, or name the batch system as scheduler")
        if self.address and not re.fullmatch(r"(tcp|tls)://.+:\d+", self.address):
            raise ValueError(f'address = "{self.address}" is not of the form tls://host:port')

    def describe(self) -> str:
        """The workers in words."""
        if self.scheduler == "address":
            return f"the scheduler at {self.address}"
        place = "this machine" if self.scheduler == "local" else f"jobs of {self.scheduler}"
        return f"{self.workers} worker{'s' * (self.workers != 1)} on {place}"


def parse_cluster(text: str, threads: int = 0) -> ClusterSettings:
    """Return the settings behind a value of ``--cluster``.

    Args:
        text: ``local:N``, the address of a scheduler, or the path of a TOML file.
        threads: threads of Dr.Jit in a worker, 0 for the cores of the worker; a TOML file has its own.

    Raises:
        MivolError: another text, an unreadable or wrong file, or an address beyond this machine without TLS.
    """
    if match := re.fullmatch(r"local:(\d+)", text):
        if int(match[1]) < 1:
            raise MivolError(f"--cluster {text} has no worker: write local:1 or more.")
        return ClusterSettings(scheduler="local", workers=int(match[1]), threads=threads)
    if "://" in text:
        try:
            return check_connection(ClusterSettings(scheduler="address", address=text, threads=threads, wait=10.0))
        except ValueError as error:
            raise error if isinstance(error, MivolError) else MivolError(f"--cluster {text}: {error}.") from None
    if not text.endswith(".toml"):
        raise MivolError(f"--cluster {text} names no cluster: write {FORMS}.")
    return check_connection(_read_file(Path(text)))


def _read_file(path: Path) -> ClusterSettings:
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        reason = "there is no such file" if isinstance(error, FileNotFoundError) else str(error)
        raise MivolError(f"--cluster {path} cannot be read ({reason}): give a TOML file that names a scheduler.") from None
    found = from_dict(raw, path.name)
    if found.security is None:
        return found
    files = {name: str((path.parent / file).resolve()) for name, file in msgspec.to_builtins(found.security).items()}
    missing = next((file for file in files.values() if not Path(file).is_file()), None)
    if missing is not None:
        raise MivolError(f"{path.name}: found no file {missing}: [security] names the files of TLS, beside {path.name}.")
    return msgspec.structs.replace(found, security=Certificates(**files))


def from_dict(raw: dict[str, Any], name: str = "cluster") -> ClusterSettings:
    """Make the settings of a cluster from dicts and lists, as in TOML.

    Args:
        raw: tables and settings.
        name: beginning of an error message.

    Raises:
        MivolError: an unknown key, a wrong type, or a value outside the domain.
    """
    check_keys({key: value for key, value in raw.items() if key != "job"}, ClusterSettings, "", name)
    try:
        return msgspec.convert(raw, ClusterSettings)
    except msgspec.ValidationError as error:
        raise MivolError(f"{name}: {explain_error(raw, str(error))}") from None


def check_connection(settings: ClusterSettings) -> ClusterSettings:
    """Refuse an address beyond this machine without TLS.

    Raises:
        MivolError: with the table to write.
    """
    if settings.scheduler != "address":
        return settings
    parts = urlsplit(settings.address)
    if parts.scheme == "tls" and settings.security is None:
        fault = f"{settings.address} needs certificates"
    elif parts.scheme == "tcp" and not is_loopback(parts.hostname or ""):
        fault = f"{settings.address} lies beyond this machine, and its connection is not encrypted"
    elif parts.scheme == "tcp" and settings.security is not None:
        raise MivolError(f'{settings.address} is not encrypted, but [security] is given: write address = "tls://...".')
    else:
        return settings
    raise MivolError(
        f"{fault}: start scheduler and workers with --tls-ca-file, --tls-cert and --tls-key, and give a TOML file with "
        f'scheduler = "address", address = "tls://{parts.netloc}" and a table [security] of ca, cert and key.'
    )


def is_loopback(host: str) -> bool:
    """Whether a host name is this machine's loopback address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
