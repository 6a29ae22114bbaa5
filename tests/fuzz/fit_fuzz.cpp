#include "fuzz/fuzz.hpp"
#include "gp2/files/fit_file.hpp"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  gp2::test::accepts([&] {
    const gp2::FitFile fit = gp2::FitFile::parse(gp2::test::text_of(data, size), "fit.json");
    try {
      static_cast<void>(fit.posterior());
    } catch (const gp2::NumericalError&) {
      // what a file says may be well-formed, but too much for double precision
    }
  });
  return 0;
}
