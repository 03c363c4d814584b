"""Whether a rig's camera has a USB device."""

from __future__ import annotations

from transports.link.kind import CameraFacts, LinkParameters, Unsuitable

__all__ = ["check_model"]


def check_model(link: LinkParameters, camera: CameraFacts) -> None:
    """Raise Unsuitable for a camera without a USB device."""
    if camera.usb_models.get(camera.model) == camera.size:
        return
    cures = " or ".join(f'model = "{name}" with its {w}x{h} pixels' for name, (w, h) in camera.usb_models.items())
    raise Unsuitable(
        f"there is no USB model for a {camera.model} of {camera.size[0]}x{camera.size[1]} pixels yet; use {cures}, "
        'or kind = "loopback"',
        "kind",
    )
