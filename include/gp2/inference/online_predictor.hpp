#pragma once

#include <array>
#include <atomic>
#include <memory>

#include "gp2/export.hpp"
#include "gp2/posterior.hpp"
#include "gp2/predictor.hpp"
#include "gp2/view.hpp"

namespace gp2 GP2_API {

/// A Predictor that goes on learning while a control loop asks it. One thread learns and publishes, one other thread, the loop,
/// takes what was published last.
///
///     gp2::OnlinePredictor online(posterior, view);
///     // the thread that learns                            // the loop
///     online.update(measured);                             auto [predictor, workspace] = online.latest();
///     online.remove_oldest(n);                             predictor.mean(state, ddq, workspace);
///     online.publish();
///
/// `latest` is wait-free and neither allocates nor frees: the two threads exchange places in a triple buffer by one atomic index, and
/// what the loop gives back the other thread destroys. What the loop has taken stays as it is until its next `latest`.
///
/// A refresh takes O(n²) operations for each new or removed number, where the reduced size is n and a posterior made anew takes O(n³).
/// The same as a Predictor of the same posterior to rounding. Through M inducing values a refresh takes O(M³), as `update` does.
class OnlinePredictor {
 public:
  /// Publishes what the posterior predicts so far.
  /// @throws InputError as Predictor and Posterior.
  OnlinePredictor(Posterior posterior, View view, Predictor::Options options = {});
  ~OnlinePredictor();
  OnlinePredictor(const OnlinePredictor&) = delete;
  OnlinePredictor& operator=(const OnlinePredictor&) = delete;

  // ---- for the thread that learns

  /// As gp2::update and gp2::remove_oldest. @throws as they do; what was learned is left as it was.
  void update(Observations added);
  void remove_oldest(int n);
  /// Goes on from another posterior, of new hyperparameters say.
  /// @throws InputError as the constructor; what was learned is left as it was.
  void replace(Posterior posterior);
  /// What was learned, published or not. Where a copy of it is held, the next update copies it too.
  [[nodiscard]] const Posterior& posterior() const { return posterior_; }
  /// Hands what was learned on to the loop. Destroys what the loop has given back.
  void publish();

  // ---- for the loop

  struct Latest {
    const Predictor& predictor;
    Predictor::Workspace& workspace;  // of the predictor, for the loop alone
  };
  /// What was published last.
  [[nodiscard]] Latest latest();

 private:
  struct Published;

  Posterior posterior_;
  View view_;
  Predictor::Options options_;

  // Each of the three places is of the learning thread, of the loop, or in the middle. The middle has a mark while it is newer than
  // the loop's.
  static constexpr unsigned is_new = 4;
  std::array<std::unique_ptr<Published>, 3> places_;
  unsigned of_learner_ = 0;
  alignas(64) std::atomic<unsigned> middle_ = 1;
  alignas(64) unsigned of_loop_ = 2;
};

}  // namespace gp2
