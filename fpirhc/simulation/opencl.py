"""Devices with OpenCL, such as graphics processors: a kernel of double precision with a loop in each work item."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Protocol

import numpy as np

from fpirhc.errors import DeviceFailed, InvalidName, NoCode, NotInstalled, nearest, package


@dataclass(frozen=True)
class Kernel:
    """A kernel on a device."""

    run: Callable[..., int]  # of (plants, cycles, first, own, start, begun, reads, results, log)
    private: int  # bytes that a plant has beside the registers, as the device's compiler tells


def loaded_kernel(source: str, device: str) -> Kernel:
    """Build the kernel `run_lanes`.

    `device`: part of the name of a device; '': the first graphics processor, else the first device.
    """
    cl = package("pyopencl", "opencl", "a device")
    chosen = _device(cl, device)
    try:
        context = cl.Context([chosen])
        queue = cl.CommandQueue(context)
    except cl.Error as error:
        raise DeviceFailed(
            f"device '{chosen.name.strip()}' does not start ({_reason(error)}): end what else uses it, or leave the device out"
        ) from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of compilers about code that they compile
            kernel = cl.Program(context, source).build().run_lanes
        private = kernel.get_work_group_info(cl.kernel_work_group_info.PRIVATE_MEM_SIZE, chosen)
    except cl.Error as error:
        raise NoCode(f"the compiler of '{chosen.name.strip()}' failed: {_reason(error)}") from None

    def run(plants: int, cycles: int, first: int, own: int, *arrays: np.ndarray) -> int:
        *given, results, log = arrays
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
        try:
            both = [cl.Buffer(context, flags, hostbuf=np.append(v, 0.0)) for v in given]  # none is empty
            made = [cl.Buffer(context, cl.mem_flags.WRITE_ONLY, max(v.nbytes, 8)) for v in (results, log)]
            kernel(queue, (plants,), None, *map(np.int64, (cycles, first, own)), *both, *made)
            for values, there in zip((results, log), made, strict=True):
                if values.size:
                    cl.enqueue_copy(queue, values, there)
        except cl.Error as error:
            raise DeviceFailed(
                f"device '{chosen.name.strip()}' failed with {plants} plants ({_reason(error)}): run fewer "
                "plants at once, or leave the device out"
            ) from None
        return 1

    return Kernel(run, int(private))


def _reason(error: Exception) -> str:
    """The line that says it: the first with an error of the device's compiler, else the first one."""
    lines = str(error).strip().splitlines()
    return next((line for line in lines if "error:" in line), lines[0] if lines else type(error).__name__).strip()


class _Device(Protocol):
    name: str
    extensions: str
    type: int


def _device(cl: ModuleType, name: str) -> _Device:
    try:
        every = [one for platform in cl.get_platforms() for one in platform.get_devices()]
    except cl.LogicError:  # no platform at all
        every = []
    able = [one for one in every if "cl_khr_fp64" in one.extensions]
    named = [one for one in able if name.lower() in one.name.lower()]
    if not able:
        raise NotInstalled("no OpenCL device with double precision is here: install the vendor's OpenCL driver")
    if not named:
        raise InvalidName(f"no OpenCL device is called '{name}'.{nearest(name, [one.name for one in able])}")
    return min(named, key=lambda one: one.type != cl.device_type.GPU)
