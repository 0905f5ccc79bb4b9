"""Detection of hardware support for bfloat16 matrix products."""

import torch


def has_fast_bfloat16() -> bool:
    """True with AMX or AVX-512 BF16 instructions; elsewhere bfloat16 is emulated and slower."""
    found = torch.cpu.get_capabilities()
    return bool(found.get("amx_bf16", False) or found.get("avx512_bf16", False))
