#pragma once

#include <cstdlib>
#include <filesystem>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <dlfcn.h>

#include "gp2/base/file.hpp"
#include "gp2/export/c_source.hpp"
#include "io_testing.hpp"

namespace gp2::test {

/// A shared library that is built from C, and loaded.
class Library {
 public:
  /// @param sources   texts by file name; those that end in .c are compiled
  /// @param compiler  with its options
  Library(const std::vector<std::pair<std::string, std::string>>& sources, const std::string& compiler) {
    std::string command = "cd '" + folder_.path().string() + "' && " + compiler +
                          " -std=c99 -Wall -Wextra -pedantic -Wconversion -Werror -fPIC -shared -I. -o lib.so";
    for (const auto& [name, text] : sources) {
      std::filesystem::create_directories((folder_ / name).parent_path());
      static_cast<void>(folder_.write(name, text));
      if (name.ends_with(".c")) command += " " + name;
    }
    if (std::system((command + " -lm 2>errors").c_str()) != 0) {
      throw std::runtime_error(command + ": " + read_file(folder_.path() / "errors"));
    }
    handle_ = dlopen((folder_.path() / "lib.so").c_str(), RTLD_NOW | RTLD_LOCAL);
    if (handle_ == nullptr) throw std::runtime_error(dlerror());
  }
  ~Library() { dlclose(handle_); }
  Library(const Library&) = delete;
  Library& operator=(const Library&) = delete;

  [[nodiscard]] bool has(const std::string& name) const { return dlsym(handle_, name.c_str()) != nullptr; }
  template <typename Function>
  [[nodiscard]] Function* get(const std::string& name) const {
    void* const symbol = dlsym(handle_, name.c_str());
    if (symbol == nullptr) throw std::runtime_error("no symbol " + name);
    return reinterpret_cast<Function*>(symbol);
  }

 private:
  TemporaryFolder folder_;
  void* handle_ = nullptr;
};

/// The functions of an exported model, in doubles or in floats.
template <typename Real>
class ExportedOf {
 public:
  ExportedOf(const CSource& source, const std::string& name, const std::string& compiler)
      : library_({{name + ".h", source.header},
                  {name + ".c", source.source},
                  {"size.c", "#include \"" + name +
                                 ".h\"\nunsigned long size_of_workspace(void);\nunsigned long size_of_workspace(void)\n{\n  "
                                 "return (unsigned long)sizeof(" +
                                 name + "_workspace);\n}\n"}},
                 compiler) {
    mean = library_.get<int(const Real*, Real*, void*)>(name + "_mean");
    if (library_.has(name + "_mean_and_stddev"))
      mean_and_stddev = library_.get<int(const Real*, Real*, Real*, void*)>(name + "_mean_and_stddev");
    if (library_.has(name + "_mean_and_jacobian"))
      mean_and_jacobian = library_.get<int(const Real*, Real*, Real*, void*)>(name + "_mean_and_jacobian");
    self_test = library_.get<int(void*)>(name + "_self_test");
    workspace_.resize(library_.get<unsigned long(void)>("size_of_workspace")() / sizeof(double) + 1, -7.7e77);
  }

  int (*mean)(const Real*, Real*, void*) = nullptr;
  int (*mean_and_stddev)(const Real*, Real*, Real*, void*) = nullptr;
  int (*mean_and_jacobian)(const Real*, Real*, Real*, void*) = nullptr;
  int (*self_test)(void*) = nullptr;
  [[nodiscard]] void* workspace() { return workspace_.data(); }

 private:
  Library library_;
  std::vector<double> workspace_;
};
using Exported = ExportedOf<double>;

}  // namespace gp2::test
