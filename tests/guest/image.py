"""What the guest boots from: Debian's kernel, never installed, and an initramfs that mounts the host's files.

    <cache>/kernel-<release>/boot/vmlinuz-<release>          the kernel as Debian ships it
    <cache>/kernel-<release>/lib/modules/<release>/          its modules, indexed by depmod
    initramfs (cpio "newc", gzip)                            busybox, init, the modules up to the root file system

Layout of a "newc" entry (cpio(5)): the magic 070701, thirteen fields of 8 hexadecimal digits (inode, mode, uid, gid,
links, mtime, size, 4 device numbers, length of the name with its NUL, checksum 0), the name and the data, each
padded with NULs to a multiple of 4. The entry TRAILER!!! ends the archive.
"""

from __future__ import annotations

import gzip
import lzma
import os
import re
import shlex
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from tests.guest.cache import made_once

__all__ = ["GuestUnavailable", "Kernel", "build_initramfs", "fetch_kernel", "prepare_step"]

ROOT_MODULES = ("virtio_pci", "virtio_net", "9pnet_virtio", "9p", "overlay")
FOLDERS = ("bin", "modules", "proc", "host", "upper", "root")
INIT = Path(__file__).with_name("init.sh")


class GuestUnavailable(Exception):
    """This machine lacks something the guest needs; the message names it and the command that brings it."""


@dataclass(frozen=True)
class Kernel:
    """A kernel package unpacked under `tree`."""

    release: str
    tree: Path

    @property
    def image(self):
        """The bootable file."""
        return self.tree / "boot" / f"vmlinuz-{self.release}"


def fetch_kernel(cache):
    """Return Debian's newest kernel, downloading and unpacking it on the first call.

    Raises GuestUnavailable where apt does not know the package or cannot fetch it.
    """
    package = _newest_package()
    kernel = Kernel(package.removeprefix("linux-image-"), cache / package.replace("linux-image", "kernel"))
    made_once(kernel.tree, lambda tree: _unpack(package, kernel.release, tree))
    return kernel


def build_initramfs(kernel, settings, destination):
    """Write the initramfs; `settings` become shell variables that init.sh reads."""
    modules = _module_files(kernel)
    lines = [f"{name}={shlex.quote(value)}" for name, value in settings.items()]
    busybox = shutil.which("busybox")
    if busybox is None:
        raise GuestUnavailable("no busybox: apt-get install busybox-static")
    archive = b"".join(
        [
            *(_cpio_entry(name, 0o040755) for name in FOLDERS),
            _cpio_entry("bin/busybox", 0o100755, Path(busybox).read_bytes()),
            _cpio_entry("init", 0o100755, INIT.read_bytes()),
            _cpio_entry("settings", 0o100644, "\n".join(lines).encode() + b"\n"),
            *(_cpio_entry(f"modules/{i:02d}.ko", 0o100644, _module_bytes(path)) for i, path in enumerate(modules)),
            _cpio_entry("TRAILER!!!", 0),
        ]
    )
    destination.write_bytes(gzip.compress(archive, compresslevel=1))


def _newest_package():
    """Ask apt which package `linux-image-amd64` stands for today."""
    try:
        listing = subprocess.run(
            ["apt-cache", "depends", "linux-image-amd64"], capture_output=True, text=True, timeout=60, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError) as error:
        raise GuestUnavailable(f"apt does not offer Debian's kernel (linux-image-amd64): {error}") from error
    found = re.search(r"Depends: (linux-image-\d\S*-amd64)", listing)
    if found is None:
        raise GuestUnavailable("apt lists no kernel behind linux-image-amd64: run apt-get update")
    return found[1]


def _unpack(package, release, tree):
    """Download `package` beside `tree`, into a folder that holds nothing else, and lay it out in `tree`."""
    scratch = tree.parent
    prepare_step(["apt-get", "download", package], scratch)
    prepare_step(["dpkg-deb", "-x", str(next(scratch.glob("*.deb"))), str(tree)], scratch)
    if not (tree / "lib").exists():  # since Debian 13 the modules lie under /usr/lib
        (tree / "lib").symlink_to("usr/lib")
    prepare_step(["depmod", "-b", str(tree), release], scratch)


def prepare_step(command, folder):
    """Run one command of the preparation in a folder; return what it printed, or raise GuestUnavailable."""
    environment = os.environ | {"PATH": f"{os.environ['PATH']}:/usr/sbin:/sbin"}
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=True
        )
    except FileNotFoundError as error:
        raise GuestUnavailable(f"no {command[0]}: apt-get install kmod dpkg apt") from error
    except subprocess.CalledProcessError as error:
        raise GuestUnavailable(f"{shlex.join(command)}: {error.stderr.strip()}") from error
    except subprocess.TimeoutExpired as error:
        raise GuestUnavailable(str(error)) from error
    return done.stdout


def _module_files(kernel):
    """Return the modules that mount the root, in the order in which they load."""
    files = {}
    for module in ROOT_MODULES:
        command = ["modprobe", "-d", str(kernel.tree), "-S", kernel.release, "--show-depends", module]
        for line in prepare_step(command, kernel.tree).splitlines():
            if line.startswith("insmod "):
                files[Path(line.removeprefix("insmod ").strip())] = None
    return list(files)


def _module_bytes(path):
    """Read a module; Debian 13 compresses them."""
    return lzma.decompress(path.read_bytes()) if path.suffix == ".xz" else path.read_bytes()


def _cpio_entry(name, mode, data=b""):
    name_bytes = name.encode() + b"\0"
    fields = (0, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(name_bytes), 0)
    head = b"070701" + b"".join(b"%08X" % field for field in fields) + name_bytes
    return _padded(head) + _padded(data)


def _padded(data):
    return data + bytes(-len(data) % 4)
