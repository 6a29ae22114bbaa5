#pragma once

#include <string>
#include <string_view>

#include "gp2/export.hpp"

namespace gp2 GP2_API {

/// Vector instructions that the processor has and the operating system saves between threads. All false off x86.
struct ProcessorFeatures {
  bool avx2 = false;    // AVX2 and FMA
  bool avx512 = false;  // AVX-512 F, CD, BW, DQ and VL
};

/// The vector instructions of this machine.
ProcessorFeatures processor_features();

/// The kernel to ask OpenBLAS for, by the environment variable OPENBLAS_CORETYPE.
///
/// OpenBLAS holds its routines once for each of many processors, the kernels, and takes the one made for the processor that it
/// recognises. A processor that it does not recognise, or a setting in the environment, may leave it with a kernel for narrower
/// vectors than the processor has.
///
/// @param kernel_in_use  its name as OpenBLAS has it, say "Haswell"
/// @return "SkylakeX" with AVX-512 and "Haswell" with AVX2 where the kernel in use does not use these instructions; "" where it
///         does, or is not known. Kernels for AMD's processors of 2011 to 2015, whose vector units are narrower than their
///         instructions, are left in place there.
std::string_view recommended_kernel(std::string_view kernel_in_use, const ProcessorFeatures& features);

/// The BLAS library that this process computes with.
struct BlasReport {
  std::string library;         // "OpenBLAS 0.3.21"; "unknown" when it is another one
  std::string kernel;          // "Haswell"; "" when the library does not say
  int n_threads = 1;           // it may use at most
  std::string fastest_kernel;  // to set instead, see recommended_kernel(); "" when the one in use is as good
  std::string advice;          // what to set and why, one line; "" when there is nothing to mend
};

/// The BLAS settings in use, as the library tells them.
///
/// gp2's library changes one setting of the process, and for a time only: while a fit, a posterior or samples are computed,
/// OpenBLAS uses one thread, or those of the fit for a single large matrix, since the bits of a result must not depend on its
/// threads. Afterwards it has as many as before, unless the program has chosen another number meanwhile, which then stays. Who
/// chooses one while gp2 computes may change last digits. OpenBLAS reads OPENBLAS_CORETYPE when it is loaded, so only who starts
/// the process can choose the kernel.
BlasReport blas_report();

}  // namespace gp2
