"""PTX of kernels without a GPU: Numba's CUDA target types and lowers, LLVM's NVPTX backend emits.

CUDA's driver and NVIDIA's compiler are not needed. Functions of CUDA's libdevice, `__nv_sin` and
the like, stay declarations.
"""

import math
from types import ModuleType, SimpleNamespace
from typing import Any

import llvmlite.binding as llvm
import numpy as np
import pytest
from numba.core import types
from numba.core.errors import TypingError
from numba.cuda import cudaimpl, dispatcher, libdevice
from numba.cuda.compiler import compile_cuda
from numba.cuda.cudadrv import nvvm
from numba.extending import intrinsic

TARGET = "sm_80"
_CAPABILITY = (8, 0)


def ptx_of(kernel: Any, kinds: tuple[Any, ...], *using: ModuleType) -> str:
    """Assembly of a kernel.

    Args:
        kernel: Python function without a result.
        kinds: Numba's types of its arguments.
        using: Modules that it calls. Meanwhile their `np` has what a device has of NumPy, no more.
    """
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple("nvptx64-nvidia-cuda")
    machine = target.create_target_machine(cpu=TARGET, opt=3)
    layout = str(machine.target_data)
    compiler_of_nvidia = SimpleNamespace(data_layout=layout, get_ir_version=lambda: (2, 0, 3, 1))
    device = SimpleNamespace(compute_capability=_CAPABILITY)
    code = kernel.__code__
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nvvm, "NVVM", lambda: compiler_of_nvidia)
        patch.setattr(dispatcher, "get_current_device", lambda: device)
        patch.setattr(dispatcher.CUDADispatcher, "get_call_template", _call_template)
        for module_used in using:
            patch.setattr(module_used, "np", _numpy_on_a_device())
            for name, part in vars(module_used).copy().items():
                if hasattr(part, "kernel"):  # CUDA's target looks for Numba's own object
                    patch.setattr(module_used, name, part.kernel)
        found = compile_cuda(kernel, types.void, kinds, cc=_CAPABILITY)
        place = (code.co_filename, code.co_firstlineno)
        library, _ = found.target_context.prepare_cuda_kernel(
            found.library, found.fndesc, False, False, {}, *place
        )
    module, *others = map(llvm.parse_assembly, library.llvm_strs)
    for other in others:
        module.link_in(other)
    module.verify()
    passes = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(3))
    passes.getModulePassManager().run(module, passes)
    return machine.emit_assembly(module)


_call_template_as_it_is = dispatcher.CUDADispatcher.get_call_template


def _call_template(self: Any, args: Any, kws: Any) -> Any:
    """With `*args` folded, as Numba's dispatcher on the CPU has it; the built-in `min` needs it."""
    _, folded = self._compiler.fold_argument_types(args, kws)
    return _call_template_as_it_is(self, folded, {})


def _numpy_on_a_device() -> ModuleType:
    found = ModuleType("numpy_on_a_device")
    names = {name: getattr(np, name) for name in ("sin", "fmax", "nan")}
    own = {"abs": math.fabs, "isnan": math.isnan, "isfinite": math.isfinite, "rint": libdevice.rint}
    vars(found).update(**names, **own, empty=_local_array)
    return found


@intrinsic(prefer_literal=True)
def _local_array(typing: Any, shape: Any) -> Any:
    """An array of a thread: its shape must be constant."""
    sizes = getattr(shape, "types", (shape,))
    if not all(isinstance(size, types.IntegerLiteral) for size in sizes):
        raise TypingError(f"the shape of memory on a device is not constant: {shape}")
    lengths = tuple(size.literal_value for size in sizes)
    kind = types.Array(types.float64, len(lengths), "C")

    def place(context: Any, builder: Any, *_: Any) -> Any:
        where = ("local", nvvm.ADDRSPACE_LOCAL)
        return cudaimpl._generic_array(context, builder, lengths, types.float64, *where)

    return kind(shape), place
