#include <cstdlib>
#include <iostream>
#include <string>

#include <gtest/gtest.h>

// RapidCheck draws its seed from the clock unless RC_PARAMS names one. Here it is fixed, with 1000 cases of each property, and
// printed so that a failure can be run again: RC_PARAMS="seed=1 max_success=100000" gives other cases, and more of them.
namespace {

class FixedSeed : public testing::Environment {
 public:
  void SetUp() override {
    const char* const given = std::getenv("RC_PARAMS");
    std::string parameters = given == nullptr ? "" : given;
    if (parameters.find("seed=") == std::string::npos) parameters += " seed=20260731";
    if (parameters.find("max_success=") == std::string::npos) parameters += " max_success=1000";
    setenv("RC_PARAMS", parameters.c_str(), 1);
    std::cout << "RC_PARAMS=\"" << parameters << "\"\n";
  }
};

// NOLINTNEXTLINE(cppcoreguidelines-owning-memory): GoogleTest owns it
[[maybe_unused]] const testing::Environment* const environment = testing::AddGlobalTestEnvironment(new FixedSeed);

}  // namespace
