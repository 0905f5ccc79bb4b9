"""A simulated USB bus with what only some devices and systems do: kernel drivers, odd endpoints."""

import errno
from dataclasses import dataclass

from usb.core import USBError

from services.acquisition.mocks.usb_backend import MockUsbBackend, UsbDeviceModel

SET_REPORT = 9


@dataclass
class OddUsbDevice(UsbDeviceModel):
    """A device that the kernel's driver holds after every plugging, and that counts its handles."""

    kernel_driver: bool = True
    num_open: int = 0
    is_configured: bool = True

    def set_plugged(self, *, plugged):
        self.kernel_driver |= plugged
        super().set_plugged(plugged=plugged)


class OddUsbBus(MockUsbBackend):
    """The bus of a system with kernel drivers, as Linux has them."""

    def open_device(self, dev):
        handle = super().open_device(dev)
        handle.model.num_open += 1
        return handle

    def close_device(self, dev_handle):
        dev_handle.model.num_open -= 1

    def set_configuration(self, dev_handle, config_value):
        dev_handle.check()
        dev_handle.model.is_configured = config_value == 1

    def get_configuration(self, dev_handle):
        dev_handle.check()
        return int(dev_handle.model.is_configured)

    def claim_interface(self, dev_handle, intf):
        super().claim_interface(dev_handle, intf)
        if dev_handle.model.kernel_driver:
            raise USBError("Resource busy", -6, errno.EBUSY)

    def is_kernel_driver_active(self, dev_handle, intf):
        return dev_handle.model.kernel_driver

    def detach_kernel_driver(self, dev_handle, intf):
        dev_handle.check()
        dev_handle.model.kernel_driver = False

    def attach_kernel_driver(self, dev_handle, intf):
        dev_handle.check()
        dev_handle.model.kernel_driver = True

    def ctrl_transfer(self, dev_handle, kind, request, value, index, data, timeout):
        if request == SET_REPORT:
            return dev_handle.deliver(data)
        return super().ctrl_transfer(dev_handle, kind, request, value, index, data, timeout)
