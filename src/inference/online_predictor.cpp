#include "gp2/inference/online_predictor.hpp"

#include <utility>

namespace gp2 {

static_assert(std::atomic<unsigned>::is_always_lock_free);

struct OnlinePredictor::Published {
  Predictor predictor;
  Predictor::Workspace workspace;
};

OnlinePredictor::OnlinePredictor(Posterior posterior, View view, Predictor::Options options)
    : posterior_(std::move(posterior)), view_(std::move(view)), options_(options) {
  replace(std::move(posterior_));
  publish();
}

OnlinePredictor::~OnlinePredictor() = default;

void OnlinePredictor::update(Observations added) { posterior_ = gp2::update(std::move(posterior_), std::move(added)); }

void OnlinePredictor::remove_oldest(int n) { posterior_ = gp2::remove_oldest(std::move(posterior_), n); }

void OnlinePredictor::replace(Posterior posterior) {
  require_view(posterior.prior(), view_);
  auto own = posterior.own_components();
  posterior_ = Posterior(Posterior::Components(own.begin(), own.end()));
}

void OnlinePredictor::publish() {
  Predictor predictor(posterior_, view_, options_);
  Predictor::Workspace workspace(predictor);
  places_[of_learner_] = std::make_unique<Published>(Published{std::move(predictor), std::move(workspace)});
  // what is written to the place comes before the loop's reads of it, and the loop's reads of what it gave back before its end
  of_learner_ = middle_.exchange(of_learner_ | is_new, std::memory_order_acq_rel) & ~is_new;
  places_[of_learner_].reset();
}

OnlinePredictor::Latest OnlinePredictor::latest() {
  if ((middle_.load(std::memory_order_relaxed) & is_new) != 0) {
    of_loop_ = middle_.exchange(of_loop_, std::memory_order_acq_rel) & ~is_new;
  }
  Published& now = *places_[of_loop_];
  return {now.predictor, now.workspace};
}

}  // namespace gp2
