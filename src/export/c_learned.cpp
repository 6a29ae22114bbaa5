#include "export/c_writer.hpp"

#include <algorithm>

#include <fmt/format.h>

namespace gp2::c_export {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

// The triangle of a component by rows, each in whole lanes, as PredictorData stores it.
std::string Writer::triangle_of(const LatentPosterior& latents, std::size_t k) {
  constexpr Index block = 64;
  std::vector<std::string> entries;
  for (Index first = 0; first < latents.size(); first += block) {
    const MatrixXd rows = latents.triangle_rows(first, std::min(block, latents.size() - first));
    for (Index i = 0; i < rows.rows(); ++i) {
      const Index n = first + i + 1;
      for (Index j = 0; j < n; ++j) entries.push_back(number(rows(i, j)));
      for (Index j = n; j < whole(n); ++j) entries.emplace_back("0");
    }
  }
  return table("real", fmt::format("triangle_{}", k), entries);
}

void Writer::write_learned() {
  if (!all_rows_) {
    std::vector<std::string> rows;
    for (const int r : view_.rows) rows.push_back(std::to_string(r));
    table("unsigned char", "view_rows", rows);
  }
  std::string list;
  for (std::size_t k = 0; k < components_.size(); ++k) {
    const Posterior::Implementation& component = *components_[k];
    const LatentPosterior& latents = *component.latents;
    const VectorXd parameters = parameters_of(view_, component.values.parameters);
    list +=
        fmt::format("  {{{}, {{\n",
                    parameters.size() == 0 ? "0" : table(fmt::format("parameters_{}", k), parameters.data(), parameters.size()));
    for (std::size_t a = 0; a < terms_.size(); ++a) {
      const Term& term = terms_[a];
      const LatentPosterior::Basis& basis = latents.latents()[term.latent];
      const MatrixXd C = component.C[term.latent], weights = basis.beta * C.transpose(), points = basis.kernel.features();
      const VectorXd values = basis.kernel.values(), scales = scales_of(basis.kernel);
      const auto name = [&](const char* what) { return fmt::format("{}_{}_{}", what, k, a); };
      const auto of = [&](const char* what, const auto& matrix) {
        return matrix.size() == 0 ? std::string("0") : table(name(what), matrix.data(), matrix.size());
      };
      list += fmt::format("    {{{}, {}, {}, {}, {}", basis.kernel.n_rows(), of("points", points), of("scale", scales),
                          of("kernel", values), of("weights", weights));
      if (has("stddev")) list += fmt::format(", {}, {}", of("loading", C), of("rows", basis.Z));
      list += "},\n";
    }
    list += "  }";
    if (has("stddev")) {
      const Index n = terms_.empty() ? 0 : latents.latents()[terms_[0].latent].kernel.n_rows();
      std::vector<std::string> row_of;
      for (const std::vector<Index>& rows : latents.row_of()) {
        for (Index j = 0; j < n; ++j)
          row_of.push_back(std::to_string(j < std::ssize(rows) ? rows[static_cast<std::size_t>(j)] : -1));
      }
      list += fmt::format(", {}, {}, {}, {}", latents.size(), latents.row_of().size(),
                          table(text("index"), fmt::format("row_of_{}", k), row_of), triangle_of(latents, k));
    }
    if (has("sums")) {
      const auto& D = latents.sums()->D;
      std::vector<std::string> begin{"0"}, columns;
      std::vector<std::string> values;
      for (Index i = 0; i < D.rows(); ++i) {
        for (Eigen::SparseMatrix<double, Eigen::RowMajor>::InnerIterator entry(D, i); entry; ++entry) {
          columns.push_back(std::to_string(entry.col()));
          values.push_back(number(entry.value()));
        }
        begin.push_back(std::to_string(columns.size()));
      }
      list += fmt::format(", {}, {}, {}", table("int", fmt::format("sum_begin_{}", k), begin),
                          table("int", fmt::format("sum_column_{}", k), columns),
                          table("real", fmt::format("sum_value_{}", k), values));
    }
    list += "},\n";
  }
  text("tables") += fmt::format("static const component components[{}] = {{\n{}}};\n", components_.size(), list);
}

}  // namespace gp2::c_export
