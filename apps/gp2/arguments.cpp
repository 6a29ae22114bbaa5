#include <cstdio>
#include <filesystem>
#include <system_error>

#include <fmt/format.h>

#include "command.hpp"
#include "gp2/error.hpp"

namespace gp2::command {

std::vector<std::string> parse_list(const std::string& text) {
  std::vector<std::string> items;
  std::size_t first = 0;
  while (first < text.size()) {
    const std::size_t end = std::min(text.find(',', first), text.size());
    if (end > first) items.push_back(text.substr(first, end - first));
    first = end + 1;
  }
  return items;
}

std::map<std::string, std::string> parse_map(const std::string& text) {
  std::map<std::string, std::string> columns;
  for (const std::string& item : parse_list(text)) {
    const std::size_t equals = item.find('=');
    if (equals == std::string::npos || equals == 0 || equals + 1 == item.size()) {
      throw InputError(fmt::format("--map: '{}' is not LOGNAME=MODELNAME, say theta1=q3", item));
    }
    const std::string name = item.substr(equals + 1);
    const auto [twice, is_new] = columns.emplace(name, item.substr(0, equals));
    if (!is_new)
      throw InputError(
          fmt::format("--map: '{}' is given two columns, '{}' and '{}'", name, twice->second, item.substr(0, equals)));
  }
  return columns;
}

CLI::Validator not_negative() {
  const auto check = [](const std::string& text) {
    return text.starts_with('-') ? "must not be negative, got " + text : std::string();
  };
  return {check, ""};
}

void require_output(const std::string& output, const std::vector<std::string>& inputs) {
  const std::filesystem::path folder = std::filesystem::path(output).parent_path();
  if (!folder.empty() && !std::filesystem::is_directory(folder)) {
    throw InputError(fmt::format("-o {}: there is no folder '{}'; make it first", output, folder.string()));
  }
  require_writable(output);
  std::error_code not_there;
  if (!std::filesystem::is_regular_file(output, not_there)) return;
  for (const std::string& input : inputs) {
    if (std::filesystem::equivalent(output, input, not_there)) {
      throw InputError(fmt::format("-o {}: that is the input {}, which would be lost; write to another file", output, input));
    }
  }
}

View PredictedSystem::view(View::Quantity quantity) const {
  View view = View::all(quantity, *prior.system);
  view.other_system = other_system;
  return view;
}

PredictedSystem predicted_system(const FitFile& fit, const std::string& path) {
  if (path.empty()) return {fit.model, nullptr, fit.prior()};
  Model other = Model::read(path);
  std::shared_ptr<const OtherSystem> other_system = make_other_system(fit.model, other, fit.prior_options);
  Prior prior = other_system->prior;
  return {std::move(other), std::move(other_system), std::move(prior)};
}

std::pair<std::string, std::string> split_at_system(const std::string& text) {
  const std::size_t at = text.rfind('@');
  if (at == std::string::npos || !text.ends_with(".toml")) return {text, ""};
  return {text.substr(0, at), text.substr(at + 1)};
}

void talk(const std::vector<std::string>& notes) {
  for (const std::string& note : notes) fmt::print(stderr, "gp2: {}\n", note);
}

}  // namespace gp2::command
