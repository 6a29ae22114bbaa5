#include "export/shims.hpp"

#include <limits>
#include <stdexcept>
#include <utility>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "export/compiled.hpp"
#include "gp2/jobs/export_job.hpp"
#include "gp2/predictor.hpp"
#include "inference/problems.hpp"
#include "input_error.hpp"

// The shims, loaded and driven as the interfaces of CasADi and acados are documented.
namespace gp2 {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using test::largest;
using test::Library;
using Int = long long;

constexpr std::uint64_t shims_seed = 272727;

test::Problem problem(const std::string& name) {
  for (test::Problem& p : test::problems(21, shims_seed)) {
    if (p.name.find(name) != std::string::npos) return std::move(p);
  }
  throw std::runtime_error("no problem " + name);
}

// ---------------------------------------------------------------- CasADi

// A function as casadi::external loads it.
struct External {
  using Eval = int(const double**, double**, Int*, double*, int);

  External(const Library& library, const std::string& name) : eval(library.get<Eval>(name)) {
    n_in = library.get<Int()>(name + "_n_in")();
    n_out = library.get<Int()>(name + "_n_out")();
    for (Int i = 0; i < n_in; ++i) {
      names.emplace_back(library.get<const char*(Int)>(name + "_name_in")(i));
      in.push_back(shape(library.get<const Int*(Int)>(name + "_sparsity_in")(i)));
    }
    for (Int i = 0; i < n_out; ++i) {
      names.emplace_back(library.get<const char*(Int)>(name + "_name_out")(i));
      out.push_back(shape(library.get<const Int*(Int)>(name + "_sparsity_out")(i)));
    }
    Int sz[4] = {-1, -1, -1, -1};
    EXPECT_EQ(library.get<int(Int*, Int*, Int*, Int*)>(name + "_work")(&sz[0], &sz[1], &sz[2], &sz[3]), 0);
    EXPECT_GE(sz[0], n_in);
    EXPECT_GE(sz[1], n_out);
    EXPECT_EQ(sz[2], 0);
    work.assign(static_cast<std::size_t>(sz[3]), -7e77);
  }

  struct Shape {
    Int rows = 0, columns = 0, entries = 0;
  };
  // a full pattern of compressed columns, dense or empty
  static Shape shape(const Int* pattern) {
    Shape s{pattern[0], pattern[1], pattern[2 + pattern[1]]};
    EXPECT_EQ(pattern[2], 0);
    EXPECT_TRUE(s.entries == 0 || s.entries == s.rows * s.columns);
    for (Int k = 0; k < s.entries; ++k) EXPECT_EQ(pattern[3 + s.columns + k], k % s.rows);
    for (Int j = 0; j <= s.columns && s.entries > 0; ++j) EXPECT_EQ(pattern[2 + j], j * s.rows);
    return s;
  }

  // inputs and outputs that are empty are null
  int call(const std::vector<VectorXd>& arguments, std::vector<VectorXd>& results) {
    std::vector<const double*> arg;
    std::vector<double*> res;
    for (const VectorXd& one : arguments) arg.push_back(one.size() == 0 ? nullptr : one.data());
    for (VectorXd& one : results) res.push_back(one.size() == 0 ? nullptr : one.data());
    return eval(arg.data(), res.data(), nullptr, work.data(), 0);
  }

  Eval* eval;
  Int n_in = 0, n_out = 0;
  std::vector<std::string> names;
  std::vector<Shape> in, out;
  std::vector<double> work;
};

TEST(CasadiShimTest, IsAnExternalFunctionWithItsJacobian) {
  for (const char* of : {"unicycle", "double_pendulum"}) {  // with inputs, and without
    const test::Problem p = problem(of);
    const Posterior posterior = test::posterior_of(p);
    const StateLayout layout = p.prior.system->layout();
    const View view = View::constrained_acceleration(*p.prior.system);
    CSourceOptions options;
    options.name = "learned";
    const CSource c = export_c(posterior, view, options);
    const Library library({{"learned.h", c.header},
                           {"learned.c", c.source},
                           {"learned_casadi.c", casadi_source("learned", layout, view.size(), options)}},
                          "gcc -O2");
    // what is not done is not there
    for (const char* absent :
         {"jac_learned_std", "fwd1_learned", "adj1_learned", "jac_jac_learned", "learned_checkout", "learned_incref"}) {
      EXPECT_FALSE(library.has(absent)) << absent;
    }
    External f(library, "learned"), jac(library, "jac_learned"), with_std(library, "learned_std");
    EXPECT_THAT(f.names, testing::ElementsAre("q", "dq", "t", "u", "mean"));
    EXPECT_THAT(jac.names,
                testing::ElementsAre("q", "dq", "t", "u", "out_mean", "jac_mean_q", "jac_mean_dq", "jac_mean_t", "jac_mean_u"));
    EXPECT_THAT(with_std.names, testing::ElementsAre("q", "dq", "t", "u", "mean", "std"));
    const Int sizes[] = {layout.nq, layout.nq, 1, layout.nu};
    for (std::size_t i = 0; i < 4; ++i) {
      EXPECT_EQ(f.in[i].rows, sizes[i]);
      EXPECT_EQ(f.in[i].columns, 1);
      EXPECT_EQ(jac.out[i].rows, view.size());
      EXPECT_EQ(jac.out[i].columns, sizes[i]);
      EXPECT_EQ(jac.out[i].entries, view.size() * sizes[i]);
    }
    EXPECT_EQ(jac.in[4].rows, view.size());
    EXPECT_EQ(jac.in[4].entries, 0);

    const Predictor predictor(posterior, view);
    Predictor::Workspace workspace = predictor.make_workspace();
    VectorXd mean(view.size()), stddev(view.size());
    MatrixXd jacobian(view.size(), layout.size());
    for (VectorXd state : p.queries.colwise()) {
      if (state.hasNaN()) state = state.array().isNaN().select(0, state);
      for (const bool null_inputs : {false, true}) {
        // a null pointer is a vector of zeros
        if (null_inputs) state.segment(layout.t(), 1 + layout.nu).setZero();
        const std::vector<VectorXd> arguments = {state.head(layout.nq), state.segment(layout.nq, layout.nq),
                                                 null_inputs ? VectorXd() : VectorXd(state.segment(layout.t(), 1)),
                                                 null_inputs ? VectorXd() : VectorXd(state.tail(layout.nu))};
        ASSERT_EQ(predictor.mean_and_jacobian(state, mean, jacobian, workspace), Predictor::Status::ok);
        ASSERT_EQ(predictor.mean_and_stddev(state, mean, stddev, workspace), Predictor::Status::ok);
        const double tolerance = 1e-11 * (1 + largest(jacobian) + largest(mean));
        std::vector<VectorXd> results = {VectorXd(view.size())};
        ASSERT_EQ(f.call(arguments, results), 0);
        EXPECT_LE(largest(results[0] - mean), tolerance);
        results = {VectorXd(view.size()), VectorXd(view.size())};
        ASSERT_EQ(with_std.call(arguments, results), 0);
        EXPECT_LE(largest(results[1] - stddev), 1e-8 * (1 + largest(stddev)));

        std::vector<VectorXd> with_mean = arguments;
        with_mean.emplace_back();
        std::vector<VectorXd> blocks;
        for (const Int size : sizes) blocks.emplace_back(view.size() * size);
        ASSERT_EQ(jac.call(with_mean, blocks), 0);
        VectorXd all(jacobian.size());
        all << blocks[0], blocks[1], blocks[2], blocks[3];
        EXPECT_LE(largest(all - jacobian.reshaped()), tolerance);
        // one block alone, and none
        std::vector<VectorXd> second = {VectorXd(), blocks[1], VectorXd(), VectorXd()};
        second[1].setZero();
        ASSERT_EQ(jac.call(with_mean, second), 0);
        EXPECT_EQ(second[1], blocks[1]);
        std::vector<VectorXd> none(4), no_mean(1);
        EXPECT_EQ(jac.call(with_mean, none), 0);
        EXPECT_EQ(f.call(arguments, no_mean), 0);
      }
    }
    // a failure is told
    const double nan = std::numeric_limits<double>::quiet_NaN();
    std::vector<VectorXd> results = {VectorXd(view.size())};
    const VectorXd bad = VectorXd::Constant(layout.nq, nan);
    EXPECT_NE(f.call({bad, bad, VectorXd(), VectorXd()}, results), 0);
  }
}

// ---------------------------------------------------------------- acados

// of blasfeo and acados, what the shim includes: the structs that the interface passes, column by column
const char* const blasfeo = R"c(#ifndef BLASFEO_STAND_IN
#define BLASFEO_STAND_IN
struct blasfeo_dvec { double *pa; };
struct blasfeo_dmat { double *pA; int m; };
#define BLASFEO_DVECEL(sx, ai) ((sx)->pa[ai])
static void blasfeo_pack_dvec(int m, double *x, int xi, struct blasfeo_dvec *sx, int ai)
{
  for (int i = 0; i < m; ++i) sx->pa[ai + i] = x[i * xi];
}
static void blasfeo_pack_tran_dmat(int m, int n, double *A, int lda, struct blasfeo_dmat *sB, int bi, int bj)
{
  for (int j = 0; j < n; ++j) {
    for (int i = 0; i < m; ++i) sB->pA[bi + j + sB->m * (bj + i)] = A[i + lda * j];
  }
}
#endif
)c";
const char* const acados = R"c(#include "blasfeo_d_aux.h"
struct blasfeo_dvec_args { struct blasfeo_dvec *x; int xi; };
struct blasfeo_dmat_args { struct blasfeo_dmat *A; int ai; int aj; };
)c";
struct Vector {
  double* data;
};
struct Matrix {
  double* data;
  int m;
};
struct VectorArgument {
  Vector* x;
  int offset;
};
struct MatrixArgument {
  Matrix* A;
  int row, column;
};

// a step of the classical method on what the predictor says
VectorXd step(const Predictor& predictor, Predictor::Workspace& workspace, const VectorXd& x, const VectorXd& u, double t,
              double h) {
  const Index nq = x.size() / 2;
  const auto rate = [&](const VectorXd& at, double time) {
    VectorXd state(x.size() + 1 + u.size()), ddq(nq), out(x.size());
    state << at, time, u;
    EXPECT_EQ(predictor.mean(state, ddq, workspace), Predictor::Status::ok);
    out << at.tail(nq), ddq;
    return out;
  };
  const VectorXd k1 = rate(x, t), k2 = rate(x + h / 2 * k1, t + h / 2), k3 = rate(x + h / 2 * k2, t + h / 2),
                 k4 = rate(x + h * k3, t + h);
  return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4);
}

TEST(AcadosShimTest, IsADiscreteStepWithItsSensitivities) {
  for (const char* of : {"unicycle", "duffing"}) {  // with inputs, and with time
    const test::Problem p = problem(of);
    SCOPED_TRACE(p.name);
    const Posterior posterior = test::posterior_of(p);
    const System& system = *p.prior.system;
    const StateLayout layout = system.layout();
    const Index nq = layout.nq, nu = layout.nu, nx = 2 * nq;
    const bool timed = p.prior.reads()[static_cast<std::size_t>(layout.t())];
    CSourceOptions options;
    options.name = "learned";
    options.stddev = false;
    const View view = View::constrained_acceleration(system);
    const double h = 0.02;
    const Library library({{"acados/utils/external_function_generic.h", acados},
                           {"blasfeo_d_aux.h", blasfeo},
                           {"learned_acados.c", acados_source(export_c(posterior, view, options), "learned", layout, h, timed)}},
                          "gcc -O2 -Wno-unused-function");
    using Function = int(void**, void**, void*);
    Function* const fun = library.get<Function>("learned_disc_fun");
    Function* const jac = library.get<Function>("learned_disc_fun_jac");
    const Predictor predictor(posterior, view);
    Predictor::Workspace workspace = predictor.make_workspace();
    const MatrixXd states = p.queries.leftCols(3);
    for (VectorXd state : states.colwise()) {
      if (state.hasNaN()) state = state.array().isNaN().select(0, state);
      double t = state[layout.t()];
      const VectorXd x = state.head(nx), u = state.tail(nu);
      // x and u lie in one vector ux, behind each other; results behind other numbers
      VectorXd ux(nu + nx), phi = VectorXd::Constant(nx + 3, -7);
      ux << u, x;
      MatrixXd of_phi = MatrixXd::Constant(nu + nx + 2, nx + 1, -7);
      Vector in_ux{ux.data()}, out_phi{phi.data()};
      Matrix out_matrix{of_phi.data(), static_cast<int>(of_phi.rows())};
      VectorArgument arg_x{&in_ux, static_cast<int>(nu)}, arg_u{&in_ux, 0}, arg_phi{&out_phi, 2};
      MatrixArgument arg_matrix{&out_matrix, 1, 1};
      void* in[] = {&arg_x, &arg_u};
      void* out[] = {&arg_phi, &arg_matrix};
      static_cast<void>(fun(in, out, timed ? &t : nullptr));
      const VectorXd expected = step(predictor, workspace, x, u, timed ? t : 0, h);
      EXPECT_LE(largest(phi.segment(2, nx) - expected), 1e-12 * (1 + largest(expected)));
      EXPECT_EQ(phi[1], -7);
      EXPECT_EQ(phi[nx + 2], -7);
      const VectorXd of_fun = phi;
      static_cast<void>(jac(in, out, timed ? &t : nullptr));
      EXPECT_EQ(phi, of_fun);
      EXPECT_EQ(of_phi.row(0).maxCoeff(), -7);
      EXPECT_EQ(of_phi.col(0).maxCoeff(), -7);
      // rows u, then x, transposed
      for (Index k = 0; k < nu + nx; ++k) {
        const auto moved = [&](double value) {
          VectorXd v = ux;
          v[k] = value;
          return step(predictor, workspace, v.tail(nx), v.head(nu), timed ? t : 0, h);
        };
        EXPECT_TRUE(
            test::matches(of_phi.row(1 + k).tail(nx).transpose(), test::central_difference(moved, ux[k], 0.05, 1e4 * test::eps)))
            << k;
      }
    }
  }
}

// ---------------------------------------------------------------- the job

FitFile file_of(const std::string& model) {
  FitFile file;
  file.model = test::model(model);
  return file;
}

TEST(ExportJobTest, WritesTheFilesOfEachTarget) {
  const FitFile fit = file_of("models/unicycle.toml");
  const Posterior posterior = test::posterior_of(problem("unicycle"));
  const auto names = [&](const ExportRequest& request) {
    std::vector<std::string> names;
    for (const auto& [name, text] : export_fit(fit, posterior, request).files) names.push_back(name);
    return names;
  };
  ExportRequest request;
  EXPECT_THAT(names(request), testing::ElementsAre("unicycle.h", "unicycle.c"));
  request.name = "wheel";
  request.to = ExportRequest::Target::casadi;
  EXPECT_THAT(names(request), testing::ElementsAre("wheel.h", "wheel.c", "wheel_casadi.c"));
  request.to = ExportRequest::Target::acados;
  request.view.time_step = 0.01;
  EXPECT_THAT(names(request), testing::ElementsAre("wheel_acados.c"));
}

TEST(ExportJobTest, SaysWhichOptionsDoNotGoTogether) {
  const FitFile fit = file_of("models/unicycle.toml");
  const Posterior posterior = test::posterior_of(problem("unicycle"));
  const auto error = [&](const ExportRequest& request) {
    return test::input_error_of([&] { static_cast<void>(export_fit(fit, posterior, request)); });
  };
  ExportRequest request;
  request.to = ExportRequest::Target::casadi;
  request.name = "two__underscores";
  EXPECT_THAT(error(request),
              testing::HasSubstr("`name`: CasADi takes names that begin with a letter and have single underscores"));
  for (const char* const name : {"NQ", "set", "exp", "sqrtf"}) {
    request.name = name;
    EXPECT_EQ(error(request), fmt::format("`name`: the code for CasADi uses '{}' itself; choose another", name));
  }
  request.single_precision = true;
  EXPECT_THAT(error(request), testing::HasSubstr("`float` goes with `to=c`: CasADi and acados compute in double precision"));
  request = {};
  request.to = ExportRequest::Target::acados;
  EXPECT_THAT(error(request),
              testing::HasSubstr("`to=acados` needs the time step of the solver: `dt=SECONDS`, positive and finite"));
  request.view.time_step = std::numeric_limits<double>::infinity();
  EXPECT_THAT(error(request), testing::HasSubstr("`dt=SECONDS`, positive and finite"));
  request.view.time_step = 0.01;
  request.jacobian = false;
  EXPECT_THAT(error(request), testing::HasSubstr("`to=acados` needs the Jacobian, which was left out"));
  request.view.quantity = View::Quantity::multipliers;
  EXPECT_THAT(error(request), testing::HasSubstr("`to=acados` is a step of the whole motion: leave `view` and `latent` out"));
}

TEST(ExportJobTest, LeavesDrawsOutThatOthersStandFor) {
  const FitFile fit = file_of("models/unicycle.toml");
  const test::Problem p = problem("unicycle");
  const Posterior posterior = Posterior::mixture(p.prior, p.observations, {p.values, p.values, p.values});
  ExportRequest request;
  request.draws_within = 0.1;
  EXPECT_THAT(export_fit(fit, posterior, request).notes, testing::ElementsAre("1 of 3 draws represent all"));
  EXPECT_THAT(export_fit(fit, posterior.component(0), request).notes,
              testing::ElementsAre("`draws_within` changes nothing: the fit has one set of hyperparameters, not draws of them"));
}

}  // namespace
}  // namespace gp2
