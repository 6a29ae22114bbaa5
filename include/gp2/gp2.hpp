#pragma once

/// Everything that a first program needs: a model and its logs in, a posterior and its predictions out.

#include "gp2/actuator.hpp"
#include "gp2/data/csv.hpp"
#include "gp2/error.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/fit.hpp"
#include "gp2/inference/online_predictor.hpp"
#include "gp2/jobs/fit_problem.hpp"
#include "gp2/model.hpp"
#include "gp2/observations.hpp"
#include "gp2/posterior.hpp"
#include "gp2/predictor.hpp"
#include "gp2/prior.hpp"
#include "gp2/simulate.hpp"
#include "gp2/system.hpp"
#include "gp2/view.hpp"
