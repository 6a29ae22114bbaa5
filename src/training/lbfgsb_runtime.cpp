// What the Fortran code of L-BFGS-B calls instead of the Fortran runtime: cmake/QuietLBFGSB.cmake renames _gfortran_NAME to
// gp2_lbfgsb_NAME. The functions obey gfortran's calling convention (since version 8: lengths of strings are std::size_t).

#include <algorithm>
#include <cstddef>

// hidden: nobody but L-BFGS-B inside this library may call them
#pragma GCC visibility push(hidden)
extern "C" {

// A write or print statement: its start, its items and its end. Nothing is printed.
void gp2_lbfgsb_st_write(void* /*statement*/) {}
void gp2_lbfgsb_transfer_integer_write(void* /*statement*/, void* /*item*/, int /*kind*/) {}
void gp2_lbfgsb_transfer_real_write(void* /*statement*/, void* /*item*/, int /*kind*/) {}
void gp2_lbfgsb_transfer_character_write(void* /*statement*/, void* /*item*/, std::size_t /*length*/) {}
void gp2_lbfgsb_transfer_array_write(void* /*statement*/, void* /*descriptor*/, int /*kind*/, std::size_t /*length*/) {}
void gp2_lbfgsb_st_write_done(void* /*statement*/) {}

// Compares two strings as if the shorter were padded with blanks: below, at or above zero as a is before, equal to or after b.
int gp2_lbfgsb_compare_string(std::size_t a_length, const char* a, std::size_t b_length, const char* b) {
  for (std::size_t i = 0; i < std::max(a_length, b_length); ++i) {
    const auto character_a = static_cast<unsigned char>(i < a_length ? a[i] : ' ');
    const auto character_b = static_cast<unsigned char>(i < b_length ? b[i] : ' ');
    if (character_a != character_b) return character_a < character_b ? -1 : 1;
  }
  return 0;
}

// The times L-BFGS-B takes are only printed.
void gp2_lbfgsb_cpu_time_4(float* seconds) { *seconds = 0; }

}  // extern "C"
#pragma GCC visibility pop
