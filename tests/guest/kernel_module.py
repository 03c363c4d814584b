"""A kernel module for the guest, built with the headers of Debian's kernel, which are never installed."""

import shutil
from hashlib import sha256

from tests.guest.cache import made_once
from tests.guest.image import prepare_step

__all__ = ["built_module"]


def built_module(source, kernel, cache):
    """Return NAME.ko of a folder with NAME.c and a Makefile, built once for each text; raises GuestUnavailable."""
    headers = made_once(cache / f"headers-{kernel.release}", lambda tree: _unpack(kernel.release, tree))
    texts = sorted(path for path in source.iterdir() if path.is_file())
    digest = sha256(b"".join(path.read_bytes() for path in texts) + kernel.release.encode()).hexdigest()[:16]

    def build(folder):
        shutil.copytree(source, folder)
        prepare_step(["make", f"KERNEL={headers}/usr/src/linux-headers-{kernel.release}"], folder)

    return next(made_once(cache / f"module-{digest}", build).glob("*.ko"))


def _unpack(release, tree):
    """Lay out the headers for one architecture, those for all, and the programs that build."""
    version, flavour = release.rsplit("-", 1)
    kernel = ".".join(version.split(".")[:2])
    packages = [f"linux-headers-{release}", f"linux-headers-{version}-common", f"linux-kbuild-{kernel}"]
    tree.mkdir()
    for package in packages:
        prepare_step(["apt-get", "download", package], tree)
        prepare_step(["dpkg-deb", "-x", str(next(tree.glob(f"{package}_*.deb"))), str(tree)], tree)
    # The package's Makefile includes the common one where an installation would have put it.
    makefile = tree / f"usr/src/linux-headers-{version}-{flavour}" / "Makefile"
    final = tree.parent.parent / tree.name
    makefile.write_text(f"include {final}/usr/src/linux-headers-{version}-common/Makefile\n")
