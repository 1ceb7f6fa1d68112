"""Industrial cameras (GigE Vision, USB3 Vision) of any maker, by GenICam and its GenTL producer, a .cti file."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from implicam.errors import HardwareError, import_extra
from implicam.hardware.protocol import Frame, Grey, incomplete_spec_error
from implicam.images import opencv

MONO_BITS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono14": 14, "Mono16": 16}
BAYER_BITS = {"8": 8, "10": 10, "12": 12, "16": 16}
# OpenCV names a mosaic by its second row and column, GenICam by its first: RG of the one is BG of the other.
BAYER_CODES = {"RG": "BG", "BG": "RG", "GR": "GB", "GB": "GR"}
COLOUR_ORDERS = {"RGB8": "RGB", "BGR8": "BGR", "RGB8Packed": "RGB", "BGR8Packed": "BGR"}


class GenICamCamera:
    """The `FrameSource` of one camera, found by its serial number through a GenTL producer.

    triggered: see `OpenCVCamera`; what exposure, gain and trigger the camera is set to is kept in the camera itself.
    """

    spec: ClassVar[str] = "genicam:SERIAL@producer.cti"

    @classmethod
    def takes(cls, spec: str) -> bool:
        """Never: such a camera is only meant where the driver's name stands before the colon.

        Args:
            spec: The words of the command line.
        """
        return False

    @classmethod
    def from_spec(cls, name: str, rest: str, *, triggered: bool = False) -> Self:
        """A camera by its serial number, not opened yet.

        Args:
            name: The camera's name in the dataset.
            rest: "SERIAL@producer.cti", the serial number and the path of the GenTL producer.
            triggered: The camera exposes only when a trigger fires.

        Raises:
            UsageError: The serial number or the producer is missing.
        """
        serial, _, producer = rest.partition("@")
        if not serial or not producer:
            raise incomplete_spec_error("camera", cls, rest)
        return cls(name, serial, producer, triggered=triggered)

    def __init__(self, name: str, serial: str, producer: Path | str, *, triggered: bool = False) -> None:
        self.name, self.serial, self.producer = name, serial, Path(producer)
        self.live = not triggered
        self._skip = 0 if triggered else 1
        self._number = 0
        self._harvester: Any = None
        self._acquirer: Any = None

    def open(self) -> None:
        """Load the producer, find the camera, start it."""
        if self._acquirer is not None:
            return
        core = import_extra("harvesters.core", "genicam", f"camera {self.name}")
        if not self.producer.is_file():
            raise HardwareError(
                f"camera {self.name}: there is no GenTL producer {self.producer}.",
                why="a .cti file comes with the software of the camera's maker",
                fix="install it; its folder is in the variable GENICAM_GENTL64_PATH",
            )
        self._harvester = core.Harvester()
        try:
            self._harvester.add_file(str(self.producer))
            self._harvester.update()
            self._acquirer = self._create_acquirer()
            self._acquirer.start()
        except Exception as error:  # each producer has exceptions of its own
            self.close()
            raise self._device_error("cannot be opened", error) from error

    def frame(self, timeout: float = 5.0) -> Frame:
        """The first picture that was exposed after the call.

        Args:
            timeout: Seconds to wait for it.

        Returns:
            The picture with the time at which it was received.

        Raises:
            HardwareError: None came in time, the camera is gone or cannot be opened, or its pixel format is not known.
        """
        self.open()
        end = time.monotonic() + timeout
        try:
            while self._fetch(0.0) is not None:
                pass  # drop old pictures from the buffers
            for _ in range(1 + self._skip):
                found = self._fetch(max(0.001, end - time.monotonic()))
                if found is None:
                    break
        except HardwareError:
            raise
        except Exception as error:
            self.close()
            raise self._device_error("is gone", error) from error
        if found is None:
            raise HardwareError(
                f"camera {self.name}: no picture within {timeout:g} s.",
                why="it is open, and sends nothing" if self._skip else "it waits for its trigger",
                fix="check TriggerMode, the exposure time and the network's packet size in the maker's viewer",
            )
        self._number += 1
        return Frame(found, self._number, time.time())

    def close(self) -> None:
        """Stop the camera and unload the producer."""
        for thing, methods in ((self._acquirer, ("stop", "destroy")), (self._harvester, ("reset",))):
            for method in methods if thing is not None else ():
                with suppress(Exception):  # an unplugged camera cannot be stopped; the rest must still be released
                    getattr(thing, method)()
        self._acquirer = self._harvester = None

    def _create_acquirer(self) -> Any:
        found = [str(info.serial_number) for info in self._harvester.device_info_list]
        if self.serial not in found:
            raise LookupError(f"the producer sees {', '.join(found) or 'no camera'}, not {self.serial}")
        return self._harvester.create({"serial_number": self.serial})

    def _fetch(self, timeout: float) -> Grey | None:
        buffer = self._acquirer.try_fetch(timeout=timeout)
        if buffer is None:
            return None
        try:
            image = buffer.payload.components[0]
            return to_grey(image.data, int(image.width), int(image.height), str(image.data_format))
        finally:
            buffer.queue()

    def _device_error(self, what: str, error: Exception) -> HardwareError:
        if isinstance(error, HardwareError):
            return error
        return HardwareError(
            f"camera {self.name} (serial number {self.serial}) {what}.",
            why=str(error) or type(error).__name__,
            fix="check power and cable, close other programs that use it, and look for it in the maker's viewer",
        )


def to_grey(data: NDArray[Any], width: int, height: int, pixel_format: str) -> Grey:
    """The values of a camera's buffer as a grey picture, a copy.

    Args:
        data: The buffer, height * width values, or three times as many where the format has three colours.
        width: In pixels.
        height: In pixels.
        pixel_format: As GenICam names it, for example "Mono12" or "BayerRG8".

    Returns:
        (height, width) float32 from 0 to 1.

    Raises:
        HardwareError: The pixel format is not known.
    """
    cv2 = opencv()
    if pixel_format in MONO_BITS:
        return _scale_to_one(data.reshape(height, width), MONO_BITS[pixel_format])
    if pixel_format in COLOUR_ORDERS:
        code = getattr(cv2, f"COLOR_{COLOUR_ORDERS[pixel_format]}2GRAY")
        return _scale_to_one(cv2.cvtColor(np.ascontiguousarray(data.reshape(height, width, 3)), code), 8)
    if pixel_format.startswith("Bayer") and pixel_format[7:] in BAYER_BITS and pixel_format[5:7] in BAYER_CODES:
        code = getattr(cv2, f"COLOR_Bayer{BAYER_CODES[pixel_format[5:7]]}2GRAY")
        mosaic = np.ascontiguousarray(data.reshape(height, width))
        return _scale_to_one(cv2.cvtColor(mosaic, code), BAYER_BITS[pixel_format[7:]])
    raise HardwareError(
        f"the camera sends its pictures as {pixel_format}.",
        why=f"known are {', '.join([*MONO_BITS, *COLOUR_ORDERS])} and BayerRG8 to BayerGB16",
        fix="set PixelFormat to Mono8 in the maker's viewer, and save it in the camera's user set",
    )


def _scale_to_one(values: NDArray[Any], bits: int) -> Grey:
    return np.asarray(values, np.float32) * np.float32(1 / (2**bits - 1))
