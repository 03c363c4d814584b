"""Identity of the boards on USB that have an IMX636, or a sensor of its family.

All have the interface, the endpoints, the control protocol and the words of the EVK4. They differ in these:

    board              vendor:product   kind   sensor      drivers
    EVK4               04B4:00F5        31     IMX636      neuromorphic_drivers, OpenEB
    EVK3 HD            04B4:00F5        30     Gen4.1      neuromorphic_drivers, OpenEB
    SilkyEvCam HD      31F7:0003        31     IMX636      neuromorphic_drivers 0.18
    SilkyEvCam HD Lite 31F7:0004        35     IMX646 (*)  neuromorphic_drivers 0.18
    uEye XCP-E         1409:8E00        31     IMX636      neuromorphic_drivers
    uEye XLS-E         1409:8E00 (*)    31 (*) IMX636 (*)  neuromorphic_drivers 0.18

(*) inferred, see below. The makers' own programs open the Silky and the uEye by plug-ins of OpenEB that are not public.

`kind` is the first byte of the answer to vendor request 72. neuromorphic_drivers lists a board by vendor, product and
kind, and compares both strings when it opens one; that of an EVK3 HD compares none. OpenEB compares neither: it reads
`Chip.compatible` and the registers of the chip.

Sources: neuromorphic_drivers (vendor, product and kind in the source of 0.16 and its successors; the strings as they
stand in the library of 0.18.2); its issue 5 (a user's SilkyEvCam HD Lite: 31F7:0004, kind 35), its pull requests 4
(SilkyEvCam HD) and 11 (uEye XLS-E: two strings, no other change); OpenEB 5.1.1, psee_universal.cpp, and the registers
that its drivers of the sensors check. Inferred:

- the sensor of the SilkyEvCam HD Lite: it has another kind than the SilkyEvCam HD, and OpenEB an HD sensor IMX646;
- the uEye XLS-E's product, kind and sensor: the pull request for it adds strings alone;
- the EVK3 HD's strings: no driver compares them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from firmware_protocol.imx636.registers import GEN41, IMX636, IMX646, Chip
from firmware_protocol.prophesee.usb import BoardIdentity


@dataclass(frozen=True)
class BoardModel(BoardIdentity):
    """Identity of a board, and its sensor.

    Attributes
    ----------
    chip
        Its sensor.
    """

    chip: Chip = IMX636


_PROPHESEE, _SILKY, _SILKY_LITE, _UEYE = (0x04B4, 0x00F5), (0x31F7, 0x0003), (0x31F7, 0x0004), (0x1409, 0x8E00)
_IDS = "IDS Imaging Development Systems GmbH"

BOARDS: Mapping[str, BoardModel] = {
    "evk4": BoardModel("EVK4", _PROPHESEE, "Prophesee", "EVK4"),
    "evk3_hd": BoardModel("EVK3 HD", _PROPHESEE, "Prophesee", "EVK3", kind=0x30, chip=GEN41, short_frames=True),
    "silkyevcam_hd": BoardModel("SilkyEvCam HD", _SILKY, "CenturyArks", "SilkyEvCam HD v03.09.00C"),
    "silkyevcam_hd_lite": BoardModel(
        "SilkyEvCam HD Lite", _SILKY_LITE, "CenturyArks", "SilkyEvCam HD Lite v03.09.01C", kind=0x35, chip=IMX646
    ),
    "ueye_xcp_e": BoardModel("uEye XCP-E", _UEYE, _IDS, "UE-39B0XCP"),
    "ueye_xls_e": BoardModel("uEye XLS-E", _UEYE, _IDS, "UE-39B2XLS"),
}
"""Boards by the name of the camera model in a rig."""
