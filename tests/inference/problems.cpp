#include "inference/problems.hpp"

#include <numbers>

#include "decompositions.hpp"

namespace gp2::test {

const Model& model_with_a_vanishing_row() {
  static const Model model = Model::parse(R"toml(
name        = "contact that lets go"
coordinates = ["x", "y", "z"]
[parameters]
m = 2.0
c = 1.3
[mechanics]
mass  = [["m", "0.2", "0"], ["0.2", "1", "0"], ["0", "0", "1.5"]]
force = ["-c*x", "c*dy", "1"]
[constraints]
acceleration = ["x*(c*ddx - 2*ddy + dx)", "x*ddz"]
[[latent]]
name       = "a"
kernel     = "se"
features   = ["x", "y", "dx"]
directions = "acceleration"
)toml",
                                          "contact that lets go");
  return model;
}

const Model& model_of_a_mass_that_may_be_indefinite() {
  static const Model model = Model::parse(R"toml(
name        = "cart"
coordinates = ["x", "y"]
[mechanics]
mass  = [["1", "x"], ["x", "1"]]
force = ["0", "0"]
[constraints]
position = ["y"]
[[latent]]
kernel     = "se"
features   = ["x"]
directions = "acceleration"
)toml",
                                          "cart");
  return model;
}

const Model& model_with_friction() {
  static const Model model = Model::parse(R"toml(
name        = "sledge"
coordinates = ["x", { name = "heading", angle = true }]
inputs      = ["u"]
[parameters]
m = 2.0
J = 0.5
e = 0.3
c = 0.7
k = 1.5
[let]
speed = "sqrt(dx^2 + k*dheading^2)"
[mechanics]
mass  = [["m", "m*e*cos(heading)"], ["m*e*cos(heading)", "J"]]
force = ["u - c*speed*dx", "-c*dheading"]
[constraints]
velocity = ["dx*cos(heading) - e*dheading"]
[[latent]]
name       = "slip"
kernel     = "matern52 + linear*periodic"
features   = ["heading", "u"]
directions = { force = [["-c*speed*dx", "k"], ["0", "e*heading"]] }
[[latent]]
name       = "rest"
kernel     = "rq + matern32 + constant"
features   = ["dx"]
directions = [["c^2*dx + k"], ["m"]]
)toml",
                                          "sledge");
  return model;
}

const Model& model_with_a_load() {
  static const Model model = Model::parse(R"toml(
name        = "runner on a bank"
coordinates = ["x", "y", "z", { name = "heading", angle = true }]
inputs      = ["u"]
[parameters]
m = 2.0
e = 0.3
h = 0.4
c = 0.7
[let]
load = "sqrt(lambda0(1)^2 + c)"
side = "lambda0(2)"
[mechanics]
mass  = [["m", "0", "0", "e*cos(heading)"], ["0", "m", "0", "e"], ["0", "0", "m", "0"], ["e*cos(heading)", "e", "0", "1"]]
force = ["u*cos(heading) - c*dx*abs(dx)", "u*sin(heading)", "-9.81*m", "-m*dheading"]
[constraints]
position = ["z - h*x^2 - 0.2*y^2"]
velocity = ["dx*sin(heading) - dy*cos(heading) + e*dheading"]
[[latent]]
name       = "friction"
kernel     = "se + linear"
features   = ["dx", "heading"]
directions = { force = [["-load*dx", "0"], ["-load*dy", "side"], ["-load*dz", "0"], ["c", "m*side*dheading"]] }
[[latent]]
name       = "wear"
kernel     = "matern52"
features   = ["lambda0(1)/m", "dx*lambda0(2)"]
directions = [["c*side"], ["0"], ["1"], ["lambda0(1) + m"]]
)toml",
                                          "runner on a bank");
  return model;
}

const Model& model_that_rubs() {
  static const Model model =
      Model::parse(changed(before_latents(model_with_a_load()),
                           {{"runner on a bank", "runner that rubs"},
                            {"load = \"sqrt(lambda0(1)^2 + c)\"\nside = \"lambda0(2)\"", "load = \"sqrt(lambda(1)^2 + 0.7*c)\""},
                            {"[\"0\", \"0\", \"m\", \"0\"]", "[\"0\", \"0\", \"m + 1\", \"0\"]"}}) +
                       R"toml([[latent]]
name       = "friction"
kernel     = "se"
features   = ["dx", "heading"]
directions = { force = [["-load*dx", "0"], ["-load*dy", "0.1*lambda(2)*abs(lambda(2))"], ["-load*dz", "0"], ["0", "0.2*load*dheading"]] }
signal_stddev = { initial = 0.1, bounds = [0.01, 1] }
[[latent]]
name       = "damping"
kernel     = "se + constant"
features   = ["heading", "x"]
positive   = true
directions = { force = [["-c*dx"], ["-dy"], ["-c*dz"], ["-0.1*m*dheading"]] }
[[latent]]
name       = "rest"
kernel     = "matern52"
features   = ["x", "dheading"]
directions = "acceleration"
[sampling]
x        = [-1, 1]
y        = [-1, 1]
heading  = [-1, 1]
dx       = [-1, 1]
dheading = [-1, 1]
u        = [-2, 2]
[truth]
force = ["-0.1*load*dx", "-0.1*load*dy", "-0.1*load*dz", "-0.3*dheading"]
)toml",
                   "runner that rubs");
  return model;
}

const Model& model_that_rubs_softly() {
  static const Model model =
      Model::parse(changed(model_that_rubs().text,
                           {{"c = 0.7\n", "c = 0.7\nbank = 0\nturn = 0\n"},
                            {"[\"z - h*x^2 - 0.2*y^2\"]", "[{ expr = \"z - h*x^2 - 0.2*y^2 - bank*t^2/2\", noise = 0.4 }]"},
                            {"[\"dx*sin(heading) - dy*cos(heading) + e*dheading\"]",
                             "[{ expr = \"dx*sin(heading) - dy*cos(heading) + e*dheading - turn*t\", noise = 0.3 }]"},
                            {"[sampling]\n", "[sampling]\nt = 0\n"}}),
                   "runner that rubs softly");
  return model;
}

const Model& another_bank() {
  static const Model other = Model::parse(
      changed(model_with_a_load().text, {{"m = 2.0", "m = 2.6"}, {"h = 0.4", "h = 0.3"}, {"z - h*x^2", "z - h*x^2 + 0.1*x^3"}}),
      "another bank");
  return other;
}

const Model& model_with_a_slipping_wheel() {
  static const Model model = Model::parse(R"toml(
name        = "slipping wheels"
coordinates = ["x", "y", { name = "heading", angle = true }, "z"]
inputs      = ["u"]
[parameters]
m = 2.0
e = 0.3
c = 0.7
[mechanics]
mass  = [["m", "0", "-m*e*sin(heading)", "0"], ["0", "m", "m*e*cos(heading)", "0"],
         ["-m*e*sin(heading)", "m*e*cos(heading)", "1.1", "0.1"], ["0", "0", "0.1", "0.4"]]
force = ["u - c*dx", "-c*dy", "-c*dheading", "-z"]
[constraints]
velocity     = [{ expr = "dx*sin(heading) - dy*cos(heading) + e*dheading", noise = 0.4 }]
acceleration = ["ddz - c*x*ddx", { expr = "m*ddy + e*dz*ddheading - y", noise = 1.5 }]
[[latent]]
name       = "f"
kernel     = "se"
features   = ["dx", "dheading"]
directions = "acceleration"
)toml",
                                          "slipping wheels");
  return model;
}

const Model& model_with_contacts() {
  static const Model model = Model::parse(R"toml(
name        = "contacts"
coordinates = ["x", "y", "z", "w"]
inputs      = ["touch"]
[parameters]
m = 2.0
h = 0.3
c = 0.7
[let]
load = "sqrt(1 + lambda0(1)^2)"
[mechanics]
mass  = [["m", "0", "0.2", "0"], ["0", "m", "0", "0.1*sin(x)"], ["0.2", "0", "1.4", "0"], ["0", "0.1*sin(x)", "0", "0.8"]]
force = ["-c*dx", "-c*y", "-m*9.81", "0.3*w"]
[constraints]
position     = [{ expr = "z - h*x^2 - 0.2*cos(y)", when = "touch > 0.5" }]
velocity     = [{ expr = "dy + c*x*dw", when = "2*x >= w - 0.3" }]
acceleration = [{ expr = "m*ddw - ddx*y - z", when = "dz < 0.2", noise = 0.3 }]
[[latent]]
name       = "friction"
kernel     = "se"
features   = ["dx", "dy"]
directions = { force = [["-load*dx", "0"], ["0.4*load", "0"], ["0", "1"], ["0", "x"]] }
)toml",
                                          "contacts");
  return model;
}

const Model& model_with_potentials() {
  static const Model model = Model::parse(R"toml(
name        = "swing on springs"
coordinates = ["x", { name = "q", angle = true }, "z"]
inputs      = ["u"]
[parameters]
m = 2.0
e = 0.3
h = 0.4
c = 0.7
[mechanics]
mass  = [["m", "m*e*cos(q)", "0"], ["m*e*cos(q)", "1", "0.1*m"], ["0", "0.1*m", "m"]]
force = ["u - c*dx", "-c*dq", "-9.81*m"]
[constraints]
position = ["z - h*x^2 - 0.2*x"]
[[latent]]
name       = "springs"
kernel     = "se + linear + matern52"
features   = ["x", "q", "z^2 - x*t"]
directions = "potential"
[[latent]]
name       = "friction"
kernel     = "se"
features   = ["dx", "dq"]
directions = { force = [["-dx", "0"], ["c", "-dq"], ["m", "0"]] }
[[latent]]
name       = "twist"
kernel     = "rq"
features   = ["x*q"]
directions = "potential"
)toml",
                                          "swing on springs");
  return model;
}

const Model& another_swing() {
  static const Model other = Model::parse(
      changed(
          model_with_potentials().text,
          {{"m = 2.0", "m = 2.6"}, {"c = 0.7", "c = { value = 0.7, estimate = true }"}, {"z - h*x^2", "z - h*x^2 + 0.1*x^3"}}),
      "another swing");
  return other;
}

std::string before_latents(const Model& model) { return model.text.substr(0, model.text.find("[[latent]]")); }

std::string changed(std::string text, const std::vector<std::pair<std::string, std::string>>& changes) {
  for (const auto& [from, to] : changes) {
    const std::size_t place = text.find(from);
    if (place == std::string::npos) throw std::runtime_error("not in the text: " + from);
    text.replace(place, from.size(), to);
  }
  return text;
}

const Model& another_surface() {
  static const Model other =
      Model::parse(changed(model("models/surface.toml").text,
                           {{"m  = 3.0", "m  = { value = 3.0, estimate = true }"},
                            {"[[\"m\", \"0\", \"0\"]", "[[\"1.5*m\", \"0.2\", \"0\"]"},
                            {"[\"0\", \"m\", \"0\"]", "[\"0.2\", \"m\", \"0\"]"},
                            {"bounds = [0.04, 0.16] }", "bounds = [0.04, 0.16], estimate = true }"},
                            {"bounds = [2.5, 3.5] }", "bounds = [2.5, 3.5], estimate = true }"},
                            {"p4 = { value = 0.1", "p4 = { value = 0.15"},
                            {"p1*q1^2 + p2*q2^2 + p3*q1*q2 + p4*cos(p5*q1) - q3", "p1*q1*q2 - 3*p2*q2 + p4*sin(p5*q2) - q3"}}),
                   "another surface");
  return other;
}

const Model& another_sledge() {
  static const Model other =
      Model::parse(changed(model_with_friction().text, {{"m = 2.0", "m = 2.6"},
                                                        {"c = 0.7", "c = { value = 0.7, estimate = true }"},
                                                        {"k = 1.5", "k = { value = 1.5, estimate = true }"},
                                                        {"dx*cos(heading) - e*dheading", "dx*sin(heading) + k*dx - e*dheading"}}),
                   "another sledge");
  return other;
}

View under(View view, std::shared_ptr<const OtherSystem> other_system) {
  view.other_system = std::move(other_system);
  return view;
}

ModelValues random_values(const Prior& prior, const std::vector<Observations>& observations, RandomStream& random) {
  ModelValues values;
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    const Latent& latent = prior.latents[a];
    VectorXd& kernel = values.kernel.emplace_back(static_cast<Index>(latent.kernel.parameters().size()));
    MatrixXd features(0, latent.n_features());
    for (const Observations& group : observations) {
      const MatrixXd more = evaluate_features(prior, a, group.states());
      features.conservativeResize(features.rows() + more.rows(), Eigen::NoChange);
      features.bottomRows(more.rows()) = more;
    }
    const VectorXd spread = row_stddev(features.transpose());
    for (Index p = 0; p < kernel.size(); ++p) {
      const Kernel::Parameter& parameter = latent.kernel.parameters()[static_cast<std::size_t>(p)];
      const bool in_feature_units =
          parameter.kind == Kernel::ParameterKind::lengthscale || parameter.kind == Kernel::ParameterKind::period;
      kernel[p] =
          (in_feature_units && spread[parameter.feature] > 0 ? 2 * spread[parameter.feature] : 1.0) * (0.7 + random.uniform());
    }
    VectorXd& signal = values.signal_stddev.emplace_back(latent.size());
    for (double& s : signal) s = 0.5 + random.uniform();
    if (latent.is_potential) signal.setConstant(signal[0]);
  }
  for (const Observations& group : observations) values.noise_stddev.push_back(group.noise().stddev());
  values.parameters = prior.system->parameter_values();
  return values;
}

Observations observe(const Model& model, View view, const MatrixXd& states, RandomStream& random) {
  MatrixXd values(view.size(), states.cols());
  if (model.truth.empty() || view.quantity != Quantity::constrained_acceleration) {
    for (double& y : values.reshaped()) y = random.normal();
  } else {
    const MatrixXd truth = true_acceleration(model, states);
    for (int row = 0; row < view.size(); ++row) values.row(row) = truth.row(view.rows[static_cast<std::size_t>(row)]);
  }
  // unequal noise of about the size of the signal: the covariance is then well conditioned, and so are the numbers compared
  const VectorXd spread = row_stddev(values);
  VectorXd stddev(view.size());
  for (Index k = 0; k < spread.size(); ++k) {
    stddev[k] = (spread[k] > 0 ? spread[k] : 1) * (0.2 + 0.4 * random.uniform());
    for (double& y : values.row(k)) y += stddev[k] * random.normal();
  }
  return {states, std::move(view), std::move(values), std::move(stddev), true};
}

std::vector<Problem> problems(int n, std::uint64_t seed) {
  std::vector<Problem> all;
  std::uint64_t stream = 0;
  const auto add = [&](const std::string& name, const Model& model, const PriorOptions& options, const MatrixXd& states,
                       const std::vector<View>& views) {
    RandomStream random(seed, ++stream);
    Problem problem{name, make_prior(model, options), {}, {}, states.rightCols(3), {}};
    for (Latent& latent : problem.prior.latents) latent.kernel_is_fixed = false;  // that of a discrepancy has derivatives too
    // a different part of the states for each view
    const Index per_view = (states.cols() - 3) / static_cast<Index>(views.size());
    for (std::size_t v = 0; v < views.size(); ++v) {
      problem.observations.push_back(
          observe(model, views[v], states.middleCols(static_cast<Index>(v) * per_view, per_view), random));
    }
    problem.values = random_values(problem.prior, problem.observations, random);
    // off the constraint, where another r or l puts the logged states, the redundant row of this model contradicts the others
    if (model.system->name().find("redundant") != std::string::npos) problem.not_estimable = {"r", "l"};
    // the signal to the size of the data, so that it is neither lost in the noise nor beyond it
    double spread = 0;
    for (const Observations& group : problem.observations) spread = std::max(spread, row_stddev(group.values()).maxCoeff());
    const PriorValues prior_values = evaluate_prior(problem.prior, states, problem.values.parameters,
                                                    require_mechanics(*problem.prior.system, states, problem.values.parameters));
    for (std::size_t a = 0; a < problem.prior.latents.size(); ++a) {
      const double size = std::sqrt(prior_values.directions[a].squaredNorm() / static_cast<double>(states.cols()));
      problem.values.signal_stddev[a] *= spread / (size > 0 ? size : 1);
    }
    all.push_back(std::move(problem));
  };
  for (const std::string& file : library_models()) {
    const Model& m = model(file);
    const MatrixXd states = draw(m, n + 3, seed).states;
    const View ddq = View::all(Quantity::constrained_acceleration, *m.system);
    const View a_bar = View::all(Quantity::unconstrained_acceleration, *m.system);
    const int last = m.system->nq() - 1;
    const std::string name = stem(file);
    add(name + ", every row", m, {}, states, {ddq});
    add(name + ", force as mean", m, {Prior::Mean::force, std::nullopt, false}, states, {ddq});
    add(name + ", one row", m, {Prior::Mean::force, std::nullopt, false}, states,
        {View{Quantity::constrained_acceleration, {last}}});
    add(name + ", two rows in another order and the unconstrained acceleration", m, {}, states,
        {View{Quantity::constrained_acceleration, {last, 0}}, a_bar});
    add(name + ", unconstrained acceleration", m, {}, states, {a_bar});
    if (m.latents.size() == 1 && m.latents[0].base == Latent::Base::acceleration) {
      PriorOptions options;
      options.discrepancy = Discrepancy{{}, VectorXd::LinSpaced(last + 1, 0.3, 1.7)};
      const MatrixXd features = evaluate_features(make_prior(m, options), 1, states);
      options.discrepancy->lengthscale = VectorXd::Ones(features.cols());
      // most states are outside
      options.discrepancy->centre = features.colwise().mean().transpose();
      options.discrepancy->half_range =
          ((features.rowwise() - features.colwise().mean()).cwiseAbs().colwise().maxCoeff().array() / 3 + 0.1).transpose();
      add(name + ", a discrepancy", m, options, states, {ddq});
    }
    if (m.latents.size() == 1) {
      add(name + ", prior on the other base", m,
          {Prior::Mean::force, m.latents[0].base == Latent::Base::force ? Latent::Base::acceleration : Latent::Base::force,
           false},
          states, {ddq});
    }
  }
  RandomStream random(seed, 1000);
  const auto random_states = [&](const Model& m) { return random_matrix(m.system->layout().size(), n + 3, random); };
  MatrixXd vanishing = random_states(model_with_a_vanishing_row());
  for (Index i = 0; i < vanishing.cols(); i += 2) vanishing(0, i) = 0;
  for (Prior::Mean mean : {Prior::Mean::zero, Prior::Mean::force}) {
    const Model& m = model_with_a_vanishing_row();
    add("a row that vanishes at some states", m, {mean, std::nullopt, false}, vanishing,
        {View::all(Quantity::constrained_acceleration, *m.system)});
    add("a row that vanishes at some states, two rows and all, a discrepancy", m,
        {mean, std::nullopt, false, Discrepancy{{}, VectorXd::LinSpaced(m.system->nq(), 0.3, 1.7)}}, vanishing,
        {View{Quantity::constrained_acceleration, {1, 0}}, View::all(Quantity::constrained_acceleration, *m.system)});
  }
  for (Prior::Mean mean : {Prior::Mean::zero, Prior::Mean::force}) {
    const Model& m = model_with_a_slipping_wheel();
    const MatrixXd states = random_states(m);
    const PriorOptions options{mean, std::nullopt, false};
    const View ddq = View::all(Quantity::constrained_acceleration, *m.system);
    add("slipping wheels", m, options, states, {ddq});
    add("slipping wheels, two rows and the constraint force", m, options, states,
        {View{Quantity::constrained_acceleration, {2, 0}}, View{Quantity::constraint_force, {0, 1, 3}}});
    add("slipping wheels, multipliers and a velocity", m, options, states,
        {View::all(Quantity::multipliers, *m.system), View::next_velocity(*m.system, 0.1)});
  }
  // x scaled: the row is dropped at x = 0 whatever c, so the rank stays as c varies
  for (Prior::Mean mean : {Prior::Mean::zero, Prior::Mean::force}) {
    const Model& m = model_with_friction();
    MatrixXd states = random_states(m);
    states.col(0).segment(m.system->nq(), m.system->nq()).setZero();
    const PriorOptions options{mean, std::nullopt, false};
    const View ddq = View::all(Quantity::constrained_acceleration, *m.system);
    add("friction, two latents, one state at rest", m, options, states, {ddq, View{Quantity::unconstrained_acceleration, {1}}});
    const auto elsewhere = make_other_system(m, another_sledge(), options);
    View alone = under(View{Quantity::constraint_force, {1, 0}}, elsewhere);
    alone.latent = 1;
    add("friction, pooled with another sledge", m, options, states, {ddq, under(ddq, elsewhere), alone});
  }
  for (Prior::Mean mean : {Prior::Mean::zero, Prior::Mean::force}) {
    const Model& m = model("models/surface.toml");
    const MatrixXd states = draw(m, n + 3, seed).states;
    for (const auto base : {Latent::Base::acceleration, Latent::Base::force}) {
      const PriorOptions options{mean, base, false};
      const auto elsewhere = make_other_system(m, another_surface(), options);
      const View ddq = View::all(Quantity::constrained_acceleration, *m.system);
      add("surface, pooled with another surface", m, options, states,
          {ddq, under(ddq, elsewhere), under(View{Quantity::unconstrained_acceleration, {2, 0}}, elsewhere)});
    }
  }
  for (const std::string& file : library_models()) {
    const Model& m = model(file);
    const MatrixXd states = draw(m, n + 3, seed).states;
    const std::string name = stem(file);
    View next = View::all(Quantity::next_velocity, *m.system);
    next.time_step = 0.1;
    View alone = View::all(Quantity::unconstrained_acceleration, *m.system);
    alone.latent = static_cast<int>(m.latents.size()) - 1;
    add(name + ", constraint force and one latent alone", m, {Prior::Mean::force, std::nullopt, false}, states,
        {View::all(Quantity::constraint_force, *m.system), alone});
    if (!states.middleRows(m.system->nq(), m.system->nq()).hasNaN()) add(name + ", next velocity", m, {}, states, {next});
    // multipliers of redundant rows are not differentiable
    const SystemValues values = m.system->evaluate(states.leftCols(1), m.system->parameter_values());
    if (m.system->nc() > 0 && Eigen::ColPivHouseholderQR<MatrixXd>(values.A(0)).rank() == m.system->nc()) {
      add(name + ", multipliers", m, {}, states, {View::all(Quantity::multipliers, *m.system)});
    }
  }
  for (Prior::Mean mean : {Prior::Mean::zero, Prior::Mean::force}) {
    const Model& m = model_with_a_load();
    const PriorOptions options{mean, std::nullopt, false};
    const View ddq = View::all(Quantity::constrained_acceleration, *m.system);
    const auto elsewhere = make_other_system(m, another_bank(), options);
    add("a load, pooled with another bank", m, options, random_states(m),
        {ddq, under(ddq, elsewhere), View::all(Quantity::constraint_force, *m.system)});
  }
  for (Prior::Mean mean : {Prior::Mean::zero, Prior::Mean::force}) {
    const Model& m = model_with_contacts();
    MatrixXd states = random_states(m);
    for (Index i = 0; i < states.cols(); ++i) states(states.rows() - 1, i) = static_cast<double>(i % 2);
    const PriorOptions options{mean, std::nullopt, false};
    const View ddq = View::all(Quantity::constrained_acceleration, *m.system);
    add("contacts", m, options, states, {ddq});
    add("contacts, multipliers and a force of constraints", m, options, states,
        {View::all(Quantity::multipliers, *m.system), View{Quantity::constraint_force, {0, 2}}});
  }
  for (Prior::Mean mean : {Prior::Mean::zero, Prior::Mean::force}) {
    const Model& m = model_with_potentials();
    const PriorOptions options{mean, std::nullopt, false};
    const View ddq = View::all(Quantity::constrained_acceleration, *m.system);
    const auto elsewhere = make_other_system(m, another_swing(), options);
    View alone = View::all(Quantity::learned_force, *m.system);
    alone.latent = 0;
    add("a potential, pooled with another swing", m, options, random_states(m), {ddq, under(ddq, elsewhere), alone});
    add("a potential, two rows", m, options, random_states(m), {View{Quantity::constrained_acceleration, {2, 0}}});
  }
  return all;
}

namespace {

// v + a ε₁ + b ε₂ + ab ε₁ε₂, ε₁² = ε₂² = 0: the last is a mixed derivative, without a formula of it
struct Dual {
  long double v = 0, a = 0, b = 0, ab = 0;

  friend Dual operator+(const Dual& x, const Dual& y) { return {x.v + y.v, x.a + y.a, x.b + y.b, x.ab + y.ab}; }
  friend Dual operator*(const Dual& x, const Dual& y) {
    return {x.v * y.v, x.v * y.a + x.a * y.v, x.v * y.b + x.b * y.v, x.v * y.ab + x.a * y.b + x.b * y.a + x.ab * y.v};
  }
  // a function of this, given its value and two derivatives
  [[nodiscard]] Dual map(long double f, long double df, long double ddf) const {
    return {f, df * a, df * b, df * ab + ddf * a * b};
  }
};

Dual exp(const Dual& x) { return x.map(std::exp(x.v), std::exp(x.v), std::exp(x.v)); }
Dual pow(const Dual& x, long double p) {
  return x.map(std::pow(x.v, p), p * std::pow(x.v, p - 1), p * (p - 1) * std::pow(x.v, p - 2));
}

// k(x, y) as kernel.hpp prints it
Dual printed_kernel(const Kernel& kernel, const VectorXd& v, const std::vector<Dual>& x, const std::vector<Dual>& y) {
  Dual sum;
  for (const Kernel::Term& term : kernel.terms()) {
    Dual r2, product;
    const Kernel::Factor& factor = term.factors.front();
    for (std::size_t d = 0; d < x.size(); ++d) {
      const Dual inverse{1 / static_cast<long double>(v[factor.first_parameter + static_cast<Index>(d)])};
      const Dual delta = inverse * (x[d] + Dual{-1} * y[d]);
      r2 = r2 + delta * delta;
      product = product + inverse * x[d] * inverse * y[d];
    }
    Dual k;
    switch (factor.primitive) {
      case Kernel::Primitive::se:
        k = exp(Dual{-0.5L} * r2);
        break;
      case Kernel::Primitive::matern52:
        if (r2.v == 0) {  // its series
          k = Dual{1} + Dual{-5.0L / 6.0L} * r2;
        } else {
          const Dual r = Dual{std::sqrt(5.0L)} * pow(r2, 0.5L);
          k = (Dual{1} + r + Dual{5.0L / 3.0L} * r2) * exp(Dual{-1} * r);
        }
        break;
      case Kernel::Primitive::rq: {
        const long double alpha = v[factor.first_parameter + static_cast<Index>(x.size())];
        k = pow(Dual{1} + Dual{1 / (2 * alpha)} * r2, -alpha);
        break;
      }
      default:
        k = product;
        break;
    }
    const long double amplitude = term.amplitude < 0 ? 1 : v[term.amplitude];
    sum = sum + Dual{amplitude * amplitude} * k;
  }
  return sum;
}

// ∂²k/∂φ∂φ'
Extended gradient_covariance(const Kernel& kernel, const VectorXd& values, const VectorXd& x, const VectorXd& y) {
  Extended covariance(x.size(), y.size());
  for (Index i = 0; i < x.size(); ++i) {
    for (Index j = 0; j < y.size(); ++j) {
      std::vector<Dual> left, right;
      for (Index d = 0; d < x.size(); ++d) {
        left.push_back({x[d], d == i ? 1.0L : 0.0L});
        right.push_back({y[d], 0, d == j ? 1.0L : 0.0L});
      }
      covariance(i, j) = printed_kernel(kernel, values, left, right).ab;
    }
  }
  return covariance;
}

}  // namespace

Extended pseudo_inverse(const Extended& matrix) {
  const Eigen::JacobiSVD<Extended> svd(matrix, Eigen::ComputeThinU | Eigen::ComputeThinV);
  const auto& sigma = svd.singularValues();
  // twice the rank tolerance of B, squared in B Bᵀ, is far below what long double resolves
  ExtendedVector inverse = sigma;
  for (auto& s : inverse) s = s > 1e-12L * sigma[0] ? 1 / s : 0;
  return svd.matrixV() * inverse.asDiagonal() * svd.matrixU().transpose();
}

DenseView dense_view(const Prior& home, const ModelValues& values, const View& view, const MatrixXd& states) {
  const Prior& prior = prior_of(home, view);
  const VectorXd parameters = parameters_of(view, values.parameters);
  const System& system = *prior.system;
  const Index nq = system.nq();
  const SystemValues mechanics = system.evaluate(states, parameters);
  DenseView dense{ExtendedVector(view.size() * states.cols()), {}, {}, {}};
  for (std::size_t a = 0; a < prior.latents.size(); ++a) dense.features.push_back(evaluate_features(prior, a, states));
  for (int i = 0; i < static_cast<int>(states.cols()); ++i) {
    const Extended M_inverse = Extended(mechanics.M(i).cast<long double>()).fullPivLu().inverse();
    // rows to unit norm, so that their size does not decide the rank
    Extended A = mechanics.A(i).cast<long double>();
    ExtendedVector b = mechanics.b(i).cast<long double>();
    ExtendedVector slip = system.constraint_noise().cast<long double>();
    for (Index row = 0; row < A.rows(); ++row) {
      const long double norm = A.row(row).norm();
      if (norm == 0) continue;
      A.row(row) /= norm;
      b[row] /= norm;
      slip[row] /= norm;
    }
    Extended L(nq, 0);
    if (A.rows() > 0) L = M_inverse * A.transpose() * pseudo_inverse(A * M_inverse * A.transpose());
    Extended T = Extended::Identity(nq, nq);
    if (A.rows() > 0) T -= L * A;
    const ExtendedVector Lb = A.rows() > 0 ? ExtendedVector(L * b) : ExtendedVector(ExtendedVector::Zero(nq));
    const Extended identity = Extended::Identity(nq, nq);
    const Extended M = mechanics.M(i).cast<long double>();
    Extended all_G = identity, all_N = Extended::Zero(nq, A.rows());
    const Extended Lslip = L * slip.asDiagonal();
    ExtendedVector all_d = ExtendedVector::Zero(nq);
    if (view.quantity == Quantity::constrained_acceleration) {
      all_G = T;
      all_d = Lb;
      all_N = Lslip;
    } else if (view.quantity == Quantity::constraint_force) {
      all_G = M * (T - identity);
      all_d = M * Lb;
      all_N = M * Lslip;
    } else if (view.quantity == Quantity::multipliers) {
      const Extended K = pseudo_inverse(mechanics.A(i).transpose().cast<long double>());
      all_G = K * M * (T - identity);
      all_d = K * M * Lb;
      all_N = K * M * Lslip;
    } else if (view.quantity == Quantity::next_velocity) {
      all_G = *view.time_step * T;
      all_d = states.col(i).segment(nq, nq).cast<long double>() + *view.time_step * Lb;
      all_N = *view.time_step * Lslip;
    } else if (view.quantity == Quantity::learned_force) {
      all_G = M;
    }
    dense.slip.push_back(view.latent ? Extended(Extended::Zero(view.size(), A.rows())) : Extended(all_N(view.rows, Eigen::all)));
    const Extended G = all_G(view.rows, Eigen::all);
    const ExtendedVector offset =
        view.latent ? ExtendedVector(ExtendedVector::Zero(view.size())) : ExtendedVector(all_d(view.rows));
    ExtendedVector mean = ExtendedVector::Zero(nq);
    if (prior.mean == Prior::Mean::force && view.has_mean()) mean = M_inverse * mechanics.F(i).cast<long double>();
    dense.mean.segment(i * view.size(), view.size()) = G * mean + offset;
    std::vector<Extended>& loadings = dense.loading.emplace_back();
    for (std::size_t a = 0; a < prior.latents.size(); ++a) {
      const Latent& latent = prior.latents[a];
      Extended E = Extended::Identity(nq, nq);
      if (latent.directions) {
        const MatrixXd entries = latent.directions->evaluate(states.col(i), parameters);
        E = Extended(entries.reshaped(nq, latent.size()).cast<long double>());
      }
      if (latent.base == Latent::Base::force) E = M_inverse * E;
      if (latent.base == Latent::Base::admissible) E -= E * pseudo_inverse(A * E) * (A * E);
      if (!view.has_latent(a)) E.setZero();
      loadings.push_back(G * E * values.signal_stddev[a].cast<long double>().asDiagonal());
    }
  }
  return dense;
}

Extended dense_covariance(const Prior& prior, const ModelValues& values, const DenseView& x, const DenseView& y) {
  const Index n = static_cast<Index>(x.loading.size()), m = static_cast<Index>(y.loading.size());
  const Index dx = x.mean.size() / n, dy = y.mean.size() / m;
  Extended covariance = Extended::Zero(x.mean.size(), y.mean.size());
  for (std::size_t a = 0; a < prior.latents.size(); ++a) {
    if (prior.latents[a].is_potential) {
      for (Index j = 0; j < m; ++j) {
        for (Index i = 0; i < n; ++i) {
          covariance.block(i * dx, j * dy, dx, dy) +=
              x.loading[static_cast<std::size_t>(i)][a] *
              gradient_covariance(prior.latents[a].kernel, values.kernel[a], x.features[a].row(i), y.features[a].row(j)) *
              y.loading[static_cast<std::size_t>(j)][a].transpose();
        }
      }
      continue;
    }
    const MatrixXd k = prior.latents[a].kernel.evaluate(x.features[a], y.features[a], values.kernel[a]);
    for (Index j = 0; j < m; ++j) {
      for (Index i = 0; i < n; ++i) {
        covariance.block(i * dx, j * dy, dx, dy) += static_cast<long double>(k(i, j)) *
                                                    x.loading[static_cast<std::size_t>(i)][a] *
                                                    y.loading[static_cast<std::size_t>(j)][a].transpose();
      }
    }
  }
  return covariance;
}

MatrixXd noise_of_values(const Problem& p, std::size_t g) {
  const MatrixXd& scale = p.observations[g].noise().scale();
  const MatrixXd ones = MatrixXd::Ones(p.observations[g].values().rows(), p.observations[g].values().cols());
  return p.values.noise_stddev[g].asDiagonal() * (scale.size() > 0 ? scale : ones);
}

Problem with_noise_scale(Problem p, std::uint64_t seed) {
  RandomStream random(seed);
  for (Observations& group : p.observations) {
    MatrixXd scale(group.values().rows(), group.values().cols());
    for (double& one : scale.reshaped()) one = std::pow(3, 2 * random.uniform() - 1);
    group = with_scale(group, std::move(scale));
  }
  return p;
}

Problem with_sums(Problem p, bool every, std::uint64_t seed) {
  RandomStream random(seed, 3);
  const auto below = [&](Index n) { return static_cast<Index>(random.uniform() * static_cast<double>(n)); };
  for (std::size_t g = 0; g < (every ? p.observations.size() : 1); ++g) {
    Observations& group = p.observations[g];
    const double scale = group.values().array().abs().mean();
    std::vector<WeightedSum> sums;
    for (int row = 0; row < group.view().size(); ++row) {
      // such sums as overlap, whose noise goes together with that of those before
      for (Index r = 0; r < group.n_data(); ++r) {
        WeightedSum& sum = sums.emplace_back();
        sum.row = row;
        sum.weights.resize(1 + below(std::min<Index>(4, group.n_data())));
        for (double& weight : sum.weights) weight = random.normal();
        sum.first = static_cast<int>(below(group.n_data() - sum.weights.size() + 1));
        sum.value = scale * random.normal();
        sum.noise.resize(1 + below(std::min<Index>(3, r + 1)));
        for (double& entry : sum.noise) entry = 0.3 * random.normal();
        sum.noise[sum.noise.size() - 1] = 0.5 + random.uniform();
      }
    }
    group = group.with_sums(std::move(sums));
  }
  return p;
}

namespace {

// What is observed of a group as sums of the values of its view, and the covariance of its noise.
std::pair<Extended, Extended> sums_of(const Problem& p, std::size_t g, const DenseView& view) {
  const Observations& group = p.observations[g];
  const MatrixXd sigma = noise_of_values(p, g);
  const Index d = sigma.rows();
  if (!group.has_sums()) {
    Extended S = sigma.reshaped().cwiseAbs2().cast<long double>().asDiagonal();
    for (Index i = 0; i < sigma.cols(); ++i) {
      const Extended& N = view.slip[static_cast<std::size_t>(i)];
      S.block(i * d, i * d, d, d) += N * N.transpose();
    }
    return {Extended::Identity(sigma.size(), sigma.size()), S};
  }
  const Index n = std::ssize(group.sums());
  Extended T = Extended::Zero(n, sigma.size()), L = Extended::Zero(n, n);
  for (Index r = 0; r < n; ++r) {
    const WeightedSum& sum = group.sums()[static_cast<std::size_t>(r)];
    for (Index i = 0; i < sum.weights.size(); ++i) T(r, (sum.first + i) * d + sum.row) = sum.weights[i];
    for (Index j = 0; j < sum.noise.size(); ++j) {
      L(r, r - sum.noise.size() + 1 + j) = static_cast<long double>(p.values.noise_stddev[g][sum.row]) * sum.noise[j];
    }
  }
  return {T, L * L.transpose()};
}

ExtendedVector values_of(const Observations& group) {
  if (!group.has_sums()) return group.values().reshaped().cast<long double>();
  ExtendedVector values(std::ssize(group.sums()));
  for (Index r = 0; r < values.size(); ++r) values[r] = group.sums()[static_cast<std::size_t>(r)].value;
  return values;
}

}  // namespace

DenseObservations dense_observations(const Problem& p) {
  DenseObservations dense;
  std::vector<Index> first{0}, first_observed{0};
  std::vector<std::pair<Extended, Extended>> sums;
  for (std::size_t g = 0; g < p.observations.size(); ++g) {
    const Observations& group = p.observations[g];
    dense.views.push_back(dense_view(p.prior, p.values, group.view(), group.states()));
    sums.push_back(sums_of(p, g, dense.views.back()));
    first.push_back(first.back() + group.values().size());
    first_observed.push_back(first_observed.back() + sums.back().first.rows());
  }
  Extended K(first.back(), first.back());
  dense.residual.resize(first_observed.back());
  dense.noise = Extended::Zero(first_observed.back(), first_observed.back());
  dense.sums = Extended::Zero(first_observed.back(), first.back());
  for (std::size_t g = 0; g < p.observations.size(); ++g) {
    const auto& [T, S] = sums[g];
    dense.sums.block(first_observed[g], first[g], T.rows(), T.cols()) = T;
    dense.noise.block(first_observed[g], first_observed[g], S.rows(), S.cols()) = S;
    dense.residual.segment(first_observed[g], T.rows()) = values_of(p.observations[g]) - T * dense.views[g].mean;
    for (std::size_t h = 0; h < p.observations.size(); ++h) {
      K.block(first[g], first[h], first[g + 1] - first[g], first[h + 1] - first[h]) =
          dense_covariance(p.prior, p.values, dense.views[g], dense.views[h]);
    }
  }
  dense.covariance = dense.sums * K * dense.sums.transpose() + dense.noise;
  return dense;
}

double dense_negative_log_likelihood(const Problem& p) {
  const DenseObservations dense = dense_observations(p);
  const Eigen::LLT<Extended> factor(dense.covariance);
  const ExtendedVector white = factor.matrixL().solve(dense.residual);
  const long double log_det_half = Extended(factor.matrixL()).diagonal().array().log().sum();
  return static_cast<double>(white.squaredNorm() / 2 + log_det_half +
                             static_cast<long double>(dense.residual.size()) * std::log(2 * std::numbers::pi_v<long double>) / 2);
}

std::pair<VectorXd, MatrixXd> dense_posterior(const Problem& p, const View& view, const MatrixXd& states) {
  const DenseObservations dense = dense_observations(p);
  const DenseView at = dense_view(p.prior, p.values, view, states);
  Extended cross(dense.sums.cols(), at.mean.size());
  Index first = 0;
  for (const DenseView& observed : dense.views) {
    cross.middleRows(first, observed.mean.size()) = dense_covariance(p.prior, p.values, observed, at);
    first += observed.mean.size();
  }
  cross = (dense.sums * cross).eval();
  const Eigen::LLT<Extended> factor(dense.covariance);
  const ExtendedVector mean = at.mean + cross.transpose() * factor.solve(dense.residual);
  const Extended covariance = dense_covariance(p.prior, p.values, at, at) - cross.transpose() * factor.solve(cross);
  return {mean.cast<double>(), covariance.cast<double>()};
}

double condition(const Problem& p) {
  const DenseObservations dense = dense_observations(p);
  const Eigen::LLT<Extended> noise(dense.noise);
  return static_cast<double>(noise.matrixL().solve(noise.matrixL().solve(dense.covariance).transpose()).norm());
}

double rounding(const Problem& p) { return 1e4 * eps * condition(p); }

Posterior posterior_of(const Problem& p) { return {p.prior, p.observations, p.values}; }

View every_acceleration(const Problem& p) { return View::all(Quantity::unconstrained_acceleration, *p.prior.system); }

Likelihood::Options every_derivative(const Problem& p) {
  Likelihood::Options options;
  options.noise_gradient = true;
  for (int k = 0; k < static_cast<int>(p.values.parameters.size()); ++k) options.gradient_parameters.push_back(k);
  return options;
}

Evaluated evaluate(const Problem& p) {
  Likelihood::Workspace workspace;
  Evaluated out;
  out.value = Likelihood(p.prior, p.observations, p.values, every_derivative(p)).evaluate(p.values, &out.gradient, workspace);
  return out;
}

}  // namespace gp2::test
