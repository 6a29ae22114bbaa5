#include <memory>

#include <fmt/core.h>

#include "command.hpp"
#include "gp2/base/file.hpp"
#include "gp2/jobs/show_job.hpp"
#include "streams.hpp"

namespace gp2::command {

namespace {

struct ShowArguments {
  std::string file;
  ShowRequest request;
};

}  // namespace

Command show_command() {
  const auto a = std::make_shared<ShowArguments>();
  return {"show", "Print M, F, the derived A and b, the parameters and the latents of a model, and the results of a fit",
          "gp2 show models/surface.toml",
          joined({{argument("FILE", a->file, "model file, or file written by gp2 fit")}, options(a->request)}),
          [a](const std::set<std::string>&) {
            const std::string text = read_file(a->file);
            print_result("{}", is_fit(text) ? show(FitFile::parse(text, a->file), a->request, with_flags)
                                            : show(Model::parse(text, a->file), a->request));
          }};
}

}  // namespace gp2::command
