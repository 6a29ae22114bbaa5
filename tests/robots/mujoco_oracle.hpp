#pragma once

#include <array>
#include <filesystem>
#include <memory>
#include <stdexcept>
#include <string>

#include <mujoco/mujoco.h>
#include <Eigen/Dense>

namespace gp2::test {

/// MuJoCo's own numbers for a robot at a state, against which ours are tested:  M ddq + bias = τ + passive.
/// Forces of equalities, limits and contacts are not among them.
class MujocoOracle {
 public:
  using Matrix6 = Eigen::Matrix<double, 6, Eigen::Dynamic>;
  using Vector6 = Eigen::Matrix<double, 6, 1>;
  using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

  explicit MujocoOracle(const std::filesystem::path& path) : model_(nullptr, mj_deleteModel), data_(nullptr, mj_deleteData) {
    std::array<char, 1000> error = {};
    model_.reset(mj_loadXML(path.c_str(), nullptr, error.data(), static_cast<int>(error.size())));
    if (!model_) throw std::runtime_error(error.data());
    // dense, whatever the size: efc_J is read below
    model_->opt.jacobian = mjJAC_DENSE;
    data_.reset(mj_makeData(model_.get()));
  }

  [[nodiscard]] int n() const { return model_->nv; }
  [[nodiscard]] const mjModel& model() const { return *model_; }
  [[nodiscard]] const mjData& data() const { return *data_; }
  [[nodiscard]] int body(const char* name) const { return id(mjOBJ_BODY, name); }
  [[nodiscard]] int site(const char* name) const { return id(mjOBJ_SITE, name); }
  [[nodiscard]] Eigen::VectorXd reference() const { return Eigen::Map<const Eigen::VectorXd>(model_->qpos0, model_->nq); }

  void set_gravity(const Eigen::Vector3d& gravity) { Eigen::Map<Eigen::Vector3d>(model_->opt.gravity) = gravity; }

  /// Everything below is at this state.
  void set_state(const Eigen::VectorXd& q, const Eigen::VectorXd& dq) {
    if (q.size() != model_->nq || dq.size() != n()) throw std::runtime_error("MujocoOracle: a state of another size");
    mjModel* m = model_.get();
    mjData* d = data_.get();
    Eigen::Map<Eigen::VectorXd>(d->qpos, m->nq) = q;
    Eigen::Map<Eigen::VectorXd>(d->qvel, m->nv) = dq;
    Eigen::Map<Eigen::VectorXd>(d->qacc, m->nv).setZero();
    mj_kinematics(m, d);
    mj_comPos(m, d);
    mj_tendon(m, d);
    mj_crb(m, d);
    mj_comVel(m, d);
    mj_passive(m, d);
    // no contacts and no rows of constraints, which would add forces
    d->ncon = 0;
    d->ne = d->nf = d->nefc = 0;
    mj_rnePostConstraint(m, d);
  }

  /// M  (n × n) [kg m² …]
  [[nodiscard]] Eigen::MatrixXd mass() const {
    RowMajor mass(n(), n());
    mj_fullM(model_.get(), mass.data(), data_->qM);
    return mass;
  }

  /// Coriolis, centrifugal and gravity forces  (n) [N m …]: what inverse dynamics asks for at ddq = 0.
  [[nodiscard]] Eigen::VectorXd bias() const {
    Eigen::VectorXd bias(n());
    mj_rne(model_.get(), data_.get(), 0, bias.data());
    return bias;
  }

  /// Springs and viscous damping of the joints  (n) [N m …]
  [[nodiscard]] Eigen::VectorXd passive() const { return Eigen::Map<const Eigen::VectorXd>(data_->qfrc_passive, n()); }

  /// Of a body's frame, or of a point given in it, in the world [m]
  [[nodiscard]] Eigen::Vector3d point(int body, const Eigen::Vector3d& local = Eigen::Vector3d::Zero()) const {
    return Eigen::Map<const Eigen::Vector3d>(data_->xpos + 3 * body) + rotation(body) * local;
  }

  /// Columns: the body's axes in the world.
  [[nodiscard]] Eigen::Matrix3d rotation(int body) const {
    return Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(data_->xmat + 9 * body);
  }

  [[nodiscard]] Eigen::Vector3d site_position(int site) const {
    return Eigen::Map<const Eigen::Vector3d>(data_->site_xpos + 3 * site);
  }

  [[nodiscard]] Eigen::Matrix3d site_rotation(int site) const {
    return Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(data_->site_xmat + 9 * site);
  }

  /// J of a point of a body: rows 0–2 its velocity, rows 3–5 the body's angular velocity, in the world's axes  (6 × n).
  [[nodiscard]] Matrix6 jacobian(int body, const Eigen::Vector3d& local = Eigen::Vector3d::Zero()) const {
    const Eigen::Vector3d at = point(body, local);
    RowMajor translation(3, n());
    RowMajor turning(3, n());
    mj_jac(model_.get(), data_.get(), translation.data(), turning.data(), at.data(), body);
    Matrix6 jacobian(6, n());
    jacobian << translation, turning;
    return jacobian;
  }

  /// J̇ dq of the same six rows: linear and angular acceleration where ddq = 0.
  [[nodiscard]] Vector6 jacobian_rate_times_velocity(int body, const Eigen::Vector3d& local = Eigen::Vector3d::Zero()) const {
    Vector6 velocity;      // MuJoCo: angular first
    Vector6 acceleration;  // of the body's origin, as an accelerometer feels it: less gravity
    mj_objectVelocity(model_.get(), data_.get(), mjOBJ_XBODY, body, velocity.data(), 0);
    mj_objectAcceleration(model_.get(), data_.get(), mjOBJ_XBODY, body, acceleration.data(), 0);
    const Eigen::Vector3d omega = velocity.head<3>();
    const Eigen::Vector3d alpha = acceleration.head<3>();
    const Eigen::Vector3d arm = rotation(body) * local;
    Vector6 result;
    result << acceleration.tail<3>() + gravity() + alpha.cross(arm) + omega.cross(omega.cross(arm)), alpha;
    return result;
  }

  struct Rows {
    Eigen::VectorXd violation;  // c(q)
    Eigen::MatrixXd jacobian;   // A = ∂c/∂q
  };

  /// The rows of all active equalities, as MuJoCo writes them (a weld's last three rows are half the vector of the relative
  /// rotation, for small ones).
  [[nodiscard]] Rows equality_rows() {
    mj_makeConstraint(model_.get(), data_.get());
    const int n_rows = data_->ne;
    Rows rows{Eigen::Map<const Eigen::VectorXd>(data_->efc_pos, n_rows), Eigen::Map<const RowMajor>(data_->efc_J, n_rows, n())};
    data_->ne = data_->nf = data_->nefc = 0;
    return rows;
  }

 private:
  [[nodiscard]] int id(mjtObj type, const char* name) const {
    const int found = mj_name2id(model_.get(), type, name);
    if (found < 0) throw std::runtime_error(std::string("MujocoOracle: there is no '") + name + "'");
    return found;
  }

  [[nodiscard]] Eigen::Vector3d gravity() const {
    if ((model_->opt.disableflags & mjDSBL_GRAVITY) != 0) return Eigen::Vector3d::Zero();
    return Eigen::Map<const Eigen::Vector3d>(model_->opt.gravity);
  }

  std::unique_ptr<mjModel, void (*)(mjModel*)> model_;
  std::unique_ptr<mjData, void (*)(mjData*)> data_;
};

}  // namespace gp2::test
