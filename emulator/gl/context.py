"""The one place where a GL context is made: offscreen, through EGL, with errors that name the packages to install.

OpenGL 4.3 core is required. Of the machine's EGL devices the first that is not a software renderer is used, else the
first that works. The renderer depends on the machine, not on the rig, so the environment may choose another one:

    EVSTIM_RENDERER           part of a renderer string, upper or lower case: llvmpipe, nvidia, radeon; `cpu` and `gl`
                              select a painter and no renderer
    GLCONTEXT_DEVICE_INDEX    number of the EGL device: no other is tried
    GLCONTEXT_LINUX_LIBEGL    file name of libEGL
    GLCONTEXT_LINUX_LIBGL     file name of libGL (libOpenGL.so.0 needs no X library)

A context belongs to the thread that made it, and does not survive `fork`: make it in the process and the thread that
draws. moderngl is imported here when it is first needed, so closed-form scenes run without any GL library.

The painter of bodies and terrain is the CPU, unless the environment or the rig selects GL:

    EVSTIM_RENDERER unset or empty    run.painter of the rig, "cpu" where the rig has no such key
    EVSTIM_RENDERER=cpu               the CPU, for every rig
    EVSTIM_RENDERER=gl                GL, by the first renderer that is no software renderer, else the first that works
    EVSTIM_RENDERER=llvmpipe          GL, by the renderer with this in its name

The presence of a graphics card selects nothing: a rig and a seed give the same events on every machine. GL averages
points in each pixel, without time derivative; the CPU gives the exact mean (docs/accuracy.md has both).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from emulator.light import MachineLacks, SceneError

if TYPE_CHECKING:
    import moderngl


PACKAGES = "libegl1 libgl1 libgl1-mesa-dri"
"""The Debian packages that give a machine without a GPU its GL."""

WANTED = "EVSTIM_RENDERER"
"""The environment's variable that selects painter and renderer."""

_PAINTERS = ("cpu", "gl")
"""Values of the variable that name no renderer."""

_VERSION = 430
_MOST_DEVICES = 16
_SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swiftshader")

# Messages of glcontext (in bare Exceptions), and their meanings.
_MEANINGS = (
    ("not loaded", "the library is not installed"),
    ("found 0 devices", "libEGL is there, but no driver for it"),
    ("eglInitialize failed", "the driver is there, but its renderer cannot be loaded"),
    ("eglCreateContext failed", "the renderer is older than OpenGL 4.3"),
    ("requested device index", "the requested device is missing; look at GLCONTEXT_DEVICE_INDEX"),
)


@dataclass(frozen=True)
class GlReport:
    """Renderers of this machine.

    Attributes
    ----------
    available : True: meshes can be drawn.
    renderer, version : GL's own strings; empty where not available.
    reason : cause and remedy where GL is not available; empty where it is.
    """

    available: bool
    renderer: str = ""
    version: str = ""
    reason: str = ""


def open_context() -> moderngl.Context:
    """Make an offscreen context in this thread; its owner releases it.

    Raises SceneError with the driver's message, its meaning and the packages to install; or with the available
    renderers, where none is the wanted one.
    """
    text = os.environ.get(WANTED, "").strip()
    part_of_name = "" if text.lower() in _PAINTERS else text
    spare: moderngl.Context | None = None
    seen: list[str] = []
    with _quiet_driver():
        for context in _contexts():
            name = renderer_name(context)
            seen.append(name)
            if part_of_name.lower() in name.lower() if part_of_name else not is_software(name):
                if spare is not None:
                    spare.release()
                return context
            if spare is None and not part_of_name:
                spare = context
            else:
                context.release()
    if spare is not None:
        return spare
    raise MachineLacks(
        f"{WANTED} = {part_of_name!r} is in the name of no renderer of this machine; there is {', '.join(seen)}. "
        "Give part of one of these names, or unset it"
    )


def renderers() -> tuple[str, ...]:
    """Return the names of all renderers of this machine, in the order in which they are tried; none without GL."""
    names = []
    with suppress(SceneError), _quiet_driver():
        for context in _contexts():
            names.append(renderer_name(context))
            context.release()
    return tuple(names)


def probe() -> GlReport:
    """Open and release a context, and report the result. Call it where no `fork` follows."""
    try:
        context = open_context()
    except SceneError as error:
        return GlReport(False, reason=str(error))
    name, version = renderer_name(context), str(context.info["GL_VERSION"])
    context.release()
    return GlReport(True, name, version)


def renderer_name(context: moderngl.Context) -> str:
    """Return the renderer string, for instance 'llvmpipe (LLVM 15.0.6, 256 bits)'."""
    return str(context.info["GL_RENDERER"])


def is_software(renderer: str) -> bool:
    """Return whether the renderer of that name draws with the processor."""
    return any(name in renderer.lower() for name in _SOFTWARE)


def _contexts() -> Iterator[moderngl.Context]:
    """Yield a context of each device that works, for the caller to release; raise the first failure if none does."""
    failure: SceneError | None = None
    works = False
    # None leaves the choice to glcontext, which reads the environment.
    indices: Iterable[int | None] = [None] if "GLCONTEXT_DEVICE_INDEX" in os.environ else range(_MOST_DEVICES)
    for index in indices:
        try:
            context = _open_device(index)
        except SceneError as error:
            failure = failure or error
            if "requested device index" in str(error):
                break  # that was the last device
        else:
            works = True
            yield context
    if not works and failure is not None:
        raise failure


def _open_device(index: int | None) -> moderngl.Context:
    try:
        import moderngl
    except ImportError as error:  # arm64 Linux has no wheel of it
        raise MachineLacks(f"no GL context: {error}; pip install moderngl builds it, with g++") from error
    settings: dict[str, Any] = {"backend": "egl"} if index is None else {"backend": "egl", "device_index": index}
    try:
        return moderngl.create_context(standalone=True, require=_VERSION, **settings)
    except Exception as error:  # glcontext raises nothing more special
        meaning = next((text for sign, text in _MEANINGS if sign in str(error)), "unknown to us")
        raise MachineLacks(f"no GL context: {error} ({meaning}). On Debian: apt install {PACKAGES}") from error


@contextmanager
def _quiet_driver() -> Iterator[None]:
    """Keep Mesa from writing on stderr the text that the exception contains too."""
    before = os.environ.get("EGL_LOG_LEVEL")
    os.environ.setdefault("EGL_LOG_LEVEL", "fatal")
    try:
        yield
    finally:
        if before is None:
            del os.environ["EGL_LOG_LEVEL"]


Painter = Literal["cpu", "gl"]

QUICK_LOOK = (
    'GL draws, by points in each pixel: a quick look, whose events differ from those of run.painter = "cpu" '
    f"(the default, with {WANTED} unset)"
)
"""Note of a scene that GL draws."""


def selected_painter(of_rig: Painter) -> Painter:
    """Return the painter: that of the environment, else that of the rig."""
    of_environment = os.environ.get(WANTED, "").strip().lower()
    if not of_environment:
        return of_rig
    return "cpu" if of_environment == "cpu" else "gl"
