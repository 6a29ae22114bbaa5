#include "prior/make_prior.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/suggestion.hpp"
#include "gp2/error.hpp"
#include "mechanics/known_multipliers.hpp"
#include "prior/code_function.hpp"
#include "prior/expression_function.hpp"
#include "prior/gradient_columns.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

namespace {

const std::string potential_kernel = "rq + linear";  // where a potential gives none; docs/priors.md says how it was chosen

// an error says of which latent it is
template <typename Work>
auto named(const LatentSpec& spec, const Work& work) {
  try {
    return work();
  } catch (const InputError& error) {
    throw InputError(fmt::format("latent '{}': {}", spec.name, error.what()));
  }
}

// n of the numbers that a function gives, which checks that it gives all of them
StateCode rows_of(std::shared_ptr<const StateFunction> all, Index first, Index n) {
  StateCode rows;
  rows.evaluate = [=](const auto& states, const auto& parameters) -> MatrixXd {
    return all->evaluate(states, parameters).middleRows(first, n);
  };
  rows.differentiate = [=](const auto& states, const auto& parameters, int index) -> MatrixXd {
    return all->differentiate(states, parameters, index).middleRows(first, n);
  };
  return rows;
}

/// Makes the latents of one prior.
class LatentMaker {
 public:
  LatentMaker(std::shared_ptr<const System> system, const PriorOptions& options, const PriorWords& words)
      : system_(std::move(system)), options_(options), words_(words) {}

  /// One latent, or one for each direction.
  [[nodiscard]] std::vector<Latent> make(const LatentSpec& spec) {
    Latent latent;
    latent.name = spec.name;
    latent.is_potential = spec.is_potential && !options_.base;
    latent.base = latent.is_potential ? Latent::Base::force : options_.base.value_or(spec.base);
    latent.lengthscale = spec.lengthscale;
    latent.signal_stddev = spec.signal_stddev;
    latent.is_positive = spec.is_positive && !options_.base;  // which it is along directions of its own
    set_features(spec, latent);
    const bool is_along = !options_.base && (!spec.directions.empty() || spec.direction_code);
    const std::string& by_default = latent.is_potential ? potential_kernel : is_along ? options_.kernel_along : options_.kernel;
    latent.kernel =
        named(spec, [&] { return Kernel::parse(spec.kernel.empty() ? by_default : spec.kernel, latent.feature_names); });
    if (latent.is_potential) require_potential(spec, latent);
    latent.feature_lengthscales =
        named(spec, [&] { return lengthscales_of(spec, latent.kernel, latent.feature_names, system_->coordinates()); });
    if (latent.is_potential) {
      set_potential_directions(spec, latent);
      return {std::move(latent)};
    }
    if (!spec.per_direction.value_or(spec.kernel.empty() && options_.per_direction)) {
      set_directions(spec, latent);
      return {std::move(latent)};
    }
    std::vector<Latent> latents;
    for (std::size_t column = 0; column < direction_names(spec, latent.base).size(); ++column) {
      set_directions(spec, latents.emplace_back(latent), column);
      latents.back().direction = latents.back().column_names.front();
    }
    return latents;
  }

  /// Features in units of the lengthscales, directions of the standard deviations, and both as T23 has them outside the data: but
  /// for one factor nothing is left to tune.
  [[nodiscard]] Latent make_discrepancy(const LatentSpec& spec, const Discrepancy& discrepancy) {
    Latent latent;
    const bool has_lengthscales = discrepancy.lengthscale.size() > 0;
    std::vector<Expression> features = set_features(spec, latent, &discrepancy.lengthscale);
    latent.name = "discrepancy";
    latent.kernel_is_fixed = latent.has_one_signal = true;
    latent.base = discrepancy.base;
    for (const Coordinate& coordinate : system_->coordinates()) latent.column_names.push_back(coordinate.acceleration());
    const Index nq = system_->nq(), n_ranges = discrepancy.half_range.size();
    if ((has_lengthscales && discrepancy.lengthscale.size() != latent.n_features()) || discrepancy.stddev.size() != nq) {
      throw InputError(fmt::format("a discrepancy must hold {} lengthscales and {} standard deviations, got {} and {}",
                                   latent.n_features(), nq, discrepancy.lengthscale.size(), discrepancy.stddev.size()));
    }
    if (discrepancy.centre.size() != n_ranges || (n_ranges > 0 && discrepancy.lengthscale.size() != n_ranges)) {
      throw InputError(
          fmt::format("a discrepancy must hold as many centres and half ranges as lengthscales, {}, or none, got {} and {}",
                      discrepancy.lengthscale.size(), discrepancy.centre.size(), n_ranges));
    }
    const bool is_code = static_cast<bool>(spec.feature_code);
    const Expression growth = is_code || n_ranges == 0 ? words_.graph.constant(1) : growth_of(features, discrepancy);
    if (n_ranges > 0) {
      latent.feature_names.emplace_back("distance outside the data");
      latent.is_of_place.push_back(false);
      if (!is_code) {
        const Expression root = words_.graph.apply(Operation::sqrt, growth);
        features.push_back(words_.graph.constant(inverse_lengthscale_outside) * (root - words_.graph.constant(1)));
        latent.features = named(spec, [&] { return ExpressionFunction::of_state(features, words_.symbols, system_); });
      }
    }
    latent.kernel = Kernel::parse("se", latent.feature_names);
    if (is_code && n_ranges > 0) {
      set_outside_of_code(spec, discrepancy, latent);
      return latent;
    }
    std::vector<Expression> directions(static_cast<std::size_t>(nq * nq), words_.graph.constant(0));
    for (Index j = 0; j < nq; ++j) {
      directions[static_cast<std::size_t>(j * nq + j)] = words_.graph.constant(discrepancy.stddev[j]) * growth;
    }
    latent.directions = ExpressionFunction::of_state_and_parameters(directions, words_.symbols, words_.graph, system_);
    return latent;
  }

 private:
  // How soon a discrepancy forgets outside the data what it is within: as little of that remains as it grows,
  // γ exp(−18 (√γ − 1)²) < 1.06.
  static constexpr double inverse_lengthscale_outside = 6;

  /// γ = 1 + s/(1 + s/15) = 16 − 225/(15 + s), s = 4 Σ_d max(0, |φ_d − m_d|/h_d − 1)², theory.md T23.
  /// @param features  in units of the lengthscales
  [[nodiscard]] Expression growth_of(const std::vector<Expression>& features, const Discrepancy& discrepancy) const {
    ExpressionGraph& graph = words_.graph;
    const VectorXd centre = discrepancy.centre.cwiseQuotient(discrepancy.lengthscale);
    const VectorXd half_range = discrepancy.half_range.cwiseQuotient(discrepancy.lengthscale);
    const Expression one = graph.constant(1);
    Expression s = graph.constant(0);
    for (Index d = 0; d < centre.size(); ++d) {
      const Expression gap = graph.apply(Operation::abs, features[static_cast<std::size_t>(d)] - graph.constant(centre[d]));
      const Expression outside = graph.apply(Operation::max, graph.constant(0), gap / graph.constant(half_range[d]) - one);
      s = s + graph.constant(4) * outside * outside;
    }
    return graph.constant(16) - graph.constant(225) / (graph.constant(15) + s);  // where s overflows too
  }

  /// The same of features that are code.
  void set_outside_of_code(const LatentSpec& spec, const Discrepancy& discrepancy, Latent& latent) const {
    const int nq = system_->nq();
    const auto growth_at = [discrepancy](const MatrixXd& features) -> Eigen::RowVectorXd {
      const MatrixXd gaps = (discrepancy.lengthscale.asDiagonal() * features).colwise() - discrepancy.centre;
      const MatrixXd of_range = discrepancy.half_range.cwiseInverse().asDiagonal() * gaps;
      const Eigen::RowVectorXd s = 4 * (of_range.cwiseAbs().array() - 1).cwiseMax(0).square().matrix().colwise().sum();
      return 16 - 225 / (15 + s.array());
    };
    StateCode features, directions;
    features.reads = directions.reads = spec.feature_code.reads;
    features.evaluate = [growth_at, of = latent.features](const auto& states, const auto& parameters) -> MatrixXd {
      const MatrixXd within = of->evaluate(states, parameters);
      MatrixXd all(within.rows() + 1, within.cols());
      all << within, inverse_lengthscale_outside * (growth_at(within).cwiseSqrt().array() - 1).matrix();
      return all;
    };
    directions.evaluate = [=, of = latent.features](const auto& states, const auto&) -> MatrixXd {
      return MatrixXd(discrepancy.stddev.asDiagonal()).reshaped() * growth_at(of->evaluate(states, VectorXd()));
    };
    directions.differentiate = [nq](const auto& states, const auto&, int) -> MatrixXd {
      return MatrixXd::Zero(nq * nq, states.cols());
    };
    latent.features = std::make_shared<CodeFunction>(std::move(features), "discrepancy: features", latent.n_features(), system_);
    latent.directions = std::make_shared<CodeFunction>(std::move(directions), "discrepancy: directions", nq * nq, system_);
  }

  static void require_potential(const LatentSpec& spec, const Latent& latent) {
    for (std::size_t d = 0; d < latent.feature_names.size(); ++d) {
      if (latent.is_of_place[d]) continue;
      throw InputError(fmt::format("latent '{}': a potential depends on coordinates and t alone, but the feature '{}' reads more",
                                   spec.name, latent.feature_names[d]));
    }
    if (has_gradient(latent.kernel)) return;
    throw InputError(fmt::format("latent '{}': the kernel of a potential is a sum of se, matern52, rq and linear, got \"{}\"",
                                 spec.name, latent.kernel.text()));
  }

  /// −Jᵀ, J = ∂φ/∂q.
  void set_potential_directions(const LatentSpec& spec, Latent& latent) {
    std::vector<Expression> entries;
    for (const std::string& name : latent.feature_names) {
      latent.column_names.push_back("d/d " + name);
      const Expression value = words_.with_values(named(spec, [&] { return words_.parse(name); }), *system_);
      for (const Expression q : words_.symbols.q) entries.push_back(-words_.graph.differentiate(value, q));
    }
    latent.directions = ExpressionFunction::of_state_and_parameters(entries, words_.symbols, words_.graph, system_);
  }

  /// @param unit  of each feature, which is not centred; empty: 1; null: 1, and it is centred
  /// @returns the features, of code none
  std::vector<Expression> set_features(const LatentSpec& spec, Latent& latent, const VectorXd* unit = nullptr) {
    if (spec.feature_code) {
      latent.feature_names = spec.features;
      StateCode code = spec.feature_code;
      latent.is_of_place.assign(spec.features.size(), code.reads && is_of_place(*code.reads));
      VectorXd centre = VectorXd::Zero(latent.n_features());
      for (Index d = 0; unit == nullptr && d < centre.size(); ++d)
        centre[d] = centre_of(spec, latent.feature_names[static_cast<std::size_t>(d)]);
      if (unit != nullptr || !centre.isZero(0)) {
        const VectorXd scale = unit != nullptr && unit->size() > 0 ? *unit : VectorXd::Ones(centre.size());
        code.evaluate = [of = code.evaluate, centre, scale](const auto& states, const auto& parameters) -> MatrixXd {
          MatrixXd values = of(states, parameters);
          // of another shape it is refused by CodeFunction
          if (values.rows() == centre.size()) values = (values.colwise() - centre).array().colwise() / scale.array();
          return values;
        };
      }
      latent.features = std::make_shared<CodeFunction>(std::move(code), fmt::format("latent '{}': features", spec.name),
                                                       latent.n_features(), system_);
      return {};
    }
    std::vector<Expression> values;
    for (const std::string& feature : spec.features) {
      for (const std::string& name :
           options_.raw_angles ? std::vector<std::string>{feature} : expand_angle(feature, system_->coordinates())) {
        latent.feature_names.push_back(name);
        const Expression value = named(spec, [&] { return words_.parse(name); });
        const std::vector<std::string> read = words_.graph.variables_of(value);
        const bool reads_multipliers = std::any_of(read.begin(), read.end(), is_multiplier);
        for (int k = 0; k < std::ssize(system_->parameters()); ++k) {
          const std::string& parameter = system_->parameters()[static_cast<std::size_t>(k)].name;
          if (std::binary_search(read.begin(), read.end(), parameter) ||
              (reads_multipliers && system_->depends_on_parameter(k))) {
            latent.feature_parameters.push_back(k);
          }
        }
        latent.is_of_place.push_back(is_of_place(read));
        const double centre = unit == nullptr ? centre_of(spec, name) : 0;
        values.push_back(words_.with_values(value, *system_) - words_.graph.constant(centre));
      }
    }
    for (std::size_t d = 0; unit != nullptr && d < std::min(values.size(), static_cast<std::size_t>(unit->size())); ++d) {
      values[d] = values[d] / words_.graph.constant((*unit)[static_cast<Index>(d)]);
    }
    latent.features = named(spec, [&] { return ExpressionFunction::of_state(values, words_.symbols, system_); });
    return values;
  }

  // parameters have their values there
  [[nodiscard]] bool is_of_place(const std::vector<std::string>& read) const {
    return std::ranges::all_of(read, [&](const std::string& name) {
      return name == "t" || system_->parameter_index(name) >= 0 ||
             std::ranges::find(system_->coordinates(), name, &Coordinate::name) != system_->coordinates().end();
    });
  }

  [[nodiscard]] double centre_of(const LatentSpec& spec, const std::string& feature) const {
    const auto centre = options_.feature_centres.find(feature);
    return spec.kernel.empty() && centre != options_.feature_centres.end() ? centre->second : 0;
  }

  [[nodiscard]] bool is_of_every_coordinate(const LatentSpec& spec) const {
    return options_.base || (spec.directions.empty() && !spec.direction_code);
  }

  [[nodiscard]] std::vector<std::string> direction_names(const LatentSpec& spec, Latent::Base base) const {
    std::vector<std::string> names;
    if (is_of_every_coordinate(spec)) {
      for (const Coordinate& coordinate : system_->coordinates()) {
        names.push_back(base == Latent::Base::force ? "force_" + coordinate.name : coordinate.acceleration());
      }
      return names;
    }
    if (spec.direction_code) return spec.direction_names;
    for (std::size_t column = 1; column <= spec.directions.front().size(); ++column) {
      names.push_back(fmt::format("direction {}", column));
    }
    return names;
  }

  /// @param only  the one column that is meant; not given: all
  void set_directions(const LatentSpec& spec, Latent& latent, std::optional<std::size_t> only = {}) {
    latent.column_names = direction_names(spec, latent.base);
    const std::size_t first = only.value_or(0), last = only ? *only + 1 : latent.column_names.size();
    if (only) latent.column_names = {latent.column_names[*only]};
    if (is_of_every_coordinate(spec) && !only) return;
    if (spec.direction_code && !options_.base) {
      const std::string what = fmt::format("latent '{}': directions", spec.name);
      const int nq = system_->nq(), n_all = nq * static_cast<int>(spec.direction_names.size());
      latent.directions = std::make_shared<CodeFunction>(spec.direction_code, what, n_all, system_);
      if (!only) return;
      StateCode column = rows_of(latent.directions, static_cast<Index>(first) * nq, nq);
      column.reads = spec.direction_code.reads;
      latent.directions = std::make_shared<CodeFunction>(std::move(column), what, nq, system_);
      return;
    }
    std::vector<Expression> entries;
    for (std::size_t column = first; column < last; ++column) {
      for (std::size_t row = 0; row < system_->coordinates().size(); ++row) {
        entries.push_back(is_of_every_coordinate(spec) ? words_.graph.constant(row == column ? 1 : 0)
                                                       : named(spec, [&] { return words_.parse(spec.directions[row][column]); }));
      }
    }
    latent.directions =
        named(spec, [&] { return ExpressionFunction::of_state_and_parameters(entries, words_.symbols, words_.graph, system_); });
  }

  std::shared_ptr<const System> system_;
  const PriorOptions& options_;
  const PriorWords& words_;
};

// What several latents leave out need not be a function of their features, but is one of what these are made of.
std::vector<std::string> entries_read_by_latents(const Prior& prior) {
  const std::vector<std::string> names = prior.system->state_names();
  std::vector<std::string> entries;
  for (int k = 0; k < std::ssize(names); ++k) {
    const auto reads = [k](const Latent& latent) {
      return latent.features->reads(k) || (latent.directions && latent.directions->reads(k));
    };
    if (std::ranges::any_of(prior.latents, reads)) entries.push_back(names[static_cast<std::size_t>(k)]);
  }
  return entries;
}

// numbers that would be passed over in silence, or fail when the prior is fitted
void require_sound_range(const LatentSpec& spec, const std::string& name, const Latent::Range& range) {
  const auto fail = [&](const std::string& text) { throw InputError(fmt::format("latent '{}': {}: {}", spec.name, name, text)); };
  for (const double value : {range.initial, range.lower, range.upper, range.median, range.log_stddev}) {
    if (!(value >= 0) || !std::isfinite(value))
      fail(fmt::format("its numbers must be positive, or 0 for the default, got {}", value));
  }
  if (range.upper > 0 && range.lower > range.upper) {
    fail(fmt::format("the lower bound {} is above the upper one {}", range.lower, range.upper));
  }
  if (range.initial > 0 && (range.initial < range.lower || (range.upper > 0 && range.initial > range.upper))) {
    fail(fmt::format("it starts at {}, outside its bounds", range.initial));
  }
  if ((range.median > 0) != (range.log_stddev > 0)) fail("median and log_stddev belong together; give both or none");
}

// what a model file's reader asks of a [[latent]], where there is no file
void require_well_formed(const LatentSpec& spec, const System& system) {
  const auto fail = [&](const std::string& text) { throw InputError(fmt::format("latent '{}': {}", spec.name, text)); };
  require_sound_range(spec, "lengthscale", spec.lengthscale);
  require_sound_range(spec, "signal_stddev", spec.signal_stddev);
  for (const auto& [feature, range] : spec.lengthscales) {
    require_sound_range(spec, fmt::format("the lengthscale of '{}'", feature), range);
  }
  if (spec.features.empty()) fail("it needs at least one feature; code needs a name for each of its numbers");
  if (spec.is_potential && (spec.feature_code || spec.direction_code)) {
    fail("a potential needs features that are expressions, so that they can be differentiated");
  }
  if (spec.direction_code) {
    if (!spec.directions.empty()) fail("its directions are given twice, as expressions and as code; leave out one");
    if (spec.direction_names.empty()) fail("directions that are code need a name for each column");
    return;
  }
  if (spec.is_potential && !spec.directions.empty())
    fail("the directions of a potential follow from its features; leave them out");
  if (spec.directions.empty() && spec.is_positive) fail("a positive latent needs directions of its own, which it acts along");
  if (spec.directions.empty()) return;
  if (std::ssize(spec.directions) != system.nq()) {
    fail(fmt::format("directions: expected {} rows, one per coordinate, got {}", system.nq(), spec.directions.size()));
  }
  for (const std::vector<std::string>& row : spec.directions) {
    if (row.empty() || row.size() != spec.directions.front().size()) {
      fail("directions: every row needs the same number of entries, at least one");
    }
  }
}

}  // namespace

std::vector<std::string> expand_angle(const std::string& feature, const std::vector<Coordinate>& coordinates) {
  const bool angle =
      std::any_of(coordinates.begin(), coordinates.end(), [&](const Coordinate& c) { return c.angle && c.name == feature; });
  if (!angle) return {feature};
  return {fmt::format("sin({})", feature), fmt::format("cos({})", feature)};
}

std::vector<Latent::Range> lengthscales_of(const LatentSpec& spec, const Kernel& kernel, const std::vector<std::string>& features,
                                           const std::vector<Coordinate>& coordinates) {
  std::vector<Latent::Range> ranges(spec.lengthscales.empty() ? 0 : features.size());
  std::vector<bool> is_taken(ranges.size(), false);
  for (const auto& [name, range] : spec.lengthscales) {
    const std::vector<std::string> meant = expand_angle(name, coordinates);
    bool is_known = false;
    for (std::size_t d = 0; d < features.size(); ++d) {
      if (features[d] != name && std::find(meant.begin(), meant.end(), features[d]) == meant.end()) continue;
      if (is_taken[d]) throw InputError(fmt::format("the lengthscale of '{}' is given twice; leave out one", features[d]));
      is_taken[d] = is_known = true;
      ranges[d] = range;
    }
    if (is_known) continue;
    std::string mend = suggestion(name, features);
    if (mend.empty()) mend = fmt::format("; its features are {}", fmt::join(features, ", "));
    throw InputError(fmt::format("no feature of this latent is called '{}'{}", name, mend));
  }
  const auto has_unit = [](const Kernel::Parameter& p) { return p.kind == Kernel::ParameterKind::lengthscale; };
  if (!ranges.empty() && std::none_of(kernel.parameters().begin(), kernel.parameters().end(), has_unit)) {
    throw InputError(fmt::format("the kernel \"{}\" has no lengthscale in the unit of a feature", kernel.text()));
  }
  return ranges;
}

Expression PriorWords::with_values(Expression e, const System& system) const {
  std::map<std::string, Expression> values;
  for (const Parameter& parameter : system.parameters()) values.emplace(parameter.name, graph.constant(parameter.value));
  return graph.substitute(e, values);
}

void require_system(const std::shared_ptr<const System>& system) {
  if (!system) throw InputError("make_prior: there is no system; a model that was never read, or was moved away, has none");
}

Prior make_prior(std::shared_ptr<const System> system, const std::vector<LatentSpec>& latents, const PriorOptions& options,
                 const PriorWords& words) {
  require_system(system);
  const internal::StepLimit limit;
  if (options.base && latents.size() > 1) {
    throw InputError(
        fmt::format("{}: `prior` replaces the directions of the one [[latent]], but this model has {}: edit the model "
                    "file instead",
                    words.source, latents.size()));
  }
  LatentMaker maker(system, options, words);
  Prior prior{std::move(system), {}, options.mean, {}};
  for (const LatentSpec& spec : latents) {
    for (Latent& latent : maker.make(spec)) prior.latents.push_back(std::move(latent));
  }
  if (options.discrepancy && !latents.empty()) {
    const LatentSpec spec =
        latents.size() == 1 ? latents.front() : LatentSpec{.name = "discrepancy", .features = entries_read_by_latents(prior)};
    prior.latents.push_back(maker.make_discrepancy(spec, *options.discrepancy));
  }
  return prior;
}

Prior make_prior(std::shared_ptr<const System> system, const std::vector<LatentSpec>& latents, const PriorOptions& options) {
  require_system(system);
  ExpressionGraph graph;
  const PriorWords names{"", graph, {graph, system->coordinates(), system->inputs(), system->parameters()}, {}};
  std::map<std::string, Expression, std::less<>> known;
  std::vector<std::string> to_suggest;
  for (const Expression symbol : names.symbols.state_and_parameters()) {
    known.emplace(symbol.variable_name(), symbol);
    to_suggest.push_back(symbol.variable_name());
  }
  const auto parse = [&](const std::string& text) {
    const auto resolve = [&](std::string_view name) -> std::optional<Expression> {
      if (is_multiplier(name)) return graph.variable(name);
      const auto found = known.find(name);
      return found == known.end() ? std::nullopt : std::optional(found->second);
    };
    return parse_expression(text, graph, resolve, to_suggest);
  };
  for (const LatentSpec& spec : latents) require_well_formed(spec, *system);
  const std::string source = system->name();
  return make_prior(std::move(system), latents, options, {source, graph, names.symbols, parse});
}

}  // namespace gp2
