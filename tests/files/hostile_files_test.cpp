// Files made to harm: each is read or refused, with words that name it, soon.

#include <cstdint>
#include <ctime>
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include <sys/stat.h>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "gp2/data/csv.hpp"
#include "gp2/files/fit_file.hpp"
#include "gp2/model.hpp"
#include "io_testing.hpp"
#include "symbolic/graph.hpp"

namespace gp2 {
namespace {

using test::input_error_of;
using testing::AllOf;
using testing::HasSubstr;
using testing::StartsWith;

class HostileFiles : public testing::Test {
 protected:
  void TearDown() override {
    // of the processor, whatever else runs beside; generous, for sanitizers
    EXPECT_LT(static_cast<double>(std::clock() - start_) / CLOCKS_PER_SEC, 15);
  }

  static std::string repeated(const std::string& text, std::size_t n) {
    std::string all;
    all.reserve(n * text.size());
    for (std::size_t k = 0; k < n; ++k) all += text;
    return all;
  }

  static std::string error_of_model(const std::string& text) {
    const std::string error = input_error_of([&] { static_cast<void>(Model::parse(text, "m.toml")); });
    EXPECT_LT(error.size(), 5000U);
    return error;
  }

  // a point on a line under a force
  static std::string model_with_force(const std::string& force, const std::string& head = "") {
    return head + "coordinates = [\"q1\"]\n[mechanics]\nmass = [[1]]\nforce = [\"" + force + "\"]\n";
  }

  static std::string error_of_csv(const std::string& text) {
    const std::string error = input_error_of([&] {
      const CsvTable table = CsvTable::parse(text, "log.csv");
      static_cast<void>(table.number(0, table.n_columns() - 1));
    });
    EXPECT_LT(error.size(), 5000U);
    return error;
  }

  static std::string error_of_fit(const std::string& text) {
    const std::string error = input_error_of([&] { static_cast<void>(FitFile::parse(text, "fit.json")); });
    EXPECT_LT(error.size(), 5000U);
    return error;
  }

 private:
  std::clock_t start_ = std::clock();
};

// ------------------------------------------------------------------------------------------------------- expressions in a model

TEST_F(HostileFiles, AMillionParenthesesAreRefusedByLineAndKey) {
  EXPECT_EQ(error_of_model(model_with_force(std::string(1'000'000, '('))),
            "m.toml:4: mechanics.force entry 1: \"" + std::string(57, '(') +
                "...\", the expression has 1000000 characters, at most 65536 are allowed; give its parts names of their own");
}

TEST_F(HostileFiles, TowersOfPowersAreReadOrRefused) {
  EXPECT_EQ(error_of_model(model_with_force("(((q1^99)^99)^99)")), "");
  EXPECT_EQ(error_of_model(model_with_force("9^9^9^9^9 + (((9^99)^99)^99)")), "");
  EXPECT_THAT(error_of_model(model_with_force("q1" + repeated("^q1", 20'000))),
              AllOf(StartsWith("m.toml:4: mechanics.force entry 1: "), HasSubstr("nested deeper than 200")));
}

// written out, the last name of a chain has 2^60 operations
std::string doubling_names(const std::string& step) {
  std::string text = "coordinates = [\"q1\", \"q2\"]\n[let]\ne0 = \"q1 + 0.1\"\n";
  for (int k = 1; k <= 60; ++k) {
    const std::string before = fmt::format("e{}", k - 1);
    std::string value;
    for (const char c : step) value += c == '@' ? before : std::string(1, c);
    text += fmt::format("e{} = \"{}\"\n", k, value);
  }
  return text + "[mechanics]\nmass = [[1, 0], [0, 1]]\n[constraints]\nposition = [\"e60 - q2\"]\n";
}

TEST_F(HostileFiles, NamesThatDoubleEachOtherSixtyTimesStaySmall) {
  for (const char* step : {"@*@", "@*@ + sin(@)", "sin(@)*cos(@)/(2 + @)", "atan2(@, @ + 1)^2", "@^@"}) {
    SCOPED_TRACE(step);
    EXPECT_EQ(error_of_model(doubling_names(step)), "");
  }
  const Model model = Model::parse(doubling_names("@*@ + sin(@)"), "m.toml");
  EXPECT_EQ(input_error_of([&] { static_cast<void>(to_string(model.expression("e60"))); }),
            "expressions: written out, this one has more than 16777216 characters; print its parts");
}

TEST_F(HostileFiles, DerivativesInTooManyParametersAreRefused) {
  std::string parameters = "[parameters]\n", sum = "q1";
  for (int k = 0; k < 7000; ++k) {
    parameters += fmt::format("p{} = 1\n", k);
    sum += fmt::format("+p{}", k);
  }
  const std::string text = "coordinates = [\"q1\"]\n" + parameters + "[mechanics]\nmass = [[1]]\nforce = [\"" + sum + "\"]\n";
  const internal::StepLimit sooner(1'000'000);  // than after the ten seconds of a model file
  EXPECT_EQ(error_of_model(text),
            "m.toml: expressions: their derivatives and tapes take more than 1000000 steps; use fewer or shorter expressions, or "
            "fewer parameters");
}

TEST_F(HostileFiles, AKernelOfManyFactorsIsRefused) {
  const std::string kernel = "se" + repeated("*se", 50'000);
  EXPECT_THAT(error_of_model(model_with_force("q1") + "[[latent]]\nfeatures = [\"q1\"]\nkernel = \"" + kernel + "\"\n"),
              AllOf(StartsWith("m.toml:7: latent.kernel: kernel \"se*se*"), HasSubstr("...\", column 60"),
                    HasSubstr("more than 20000 factors")));
}

// --------------------------------------------------------------------------------------------------------------- the model file

TEST_F(HostileFiles, HalfAMillionEntriesAreReadOrRefused) {
  const std::string zeros = "[" + repeated("0,", 450'000) + "]";
  const auto expect = [&](const std::string& text, const std::string& error) { EXPECT_EQ(error_of_model(text), error); };
  expect("coordinates = " + zeros, "m.toml:1: coordinates: expected a text in quotes, got 0");
  expect("coordinates = [\"q1\"]\n[mechanics]\nmass = " + zeros,
         "m.toml:3: mechanics.mass: expected 1 rows, one per coordinate, got 450000");
  expect(model_with_force("q1") + "[noise]\nddq = " + zeros,
         "m.toml:6: noise.ddq: expected one value or 1, one per coordinate, got 450000");
  expect(model_with_force("q1") + "[[latent]]\nfeatures = " + zeros, "m.toml:6: latent.features: '0' stands twice; remove one");
  EXPECT_THAT(error_of_model("name = " + zeros), StartsWith("m.toml:1: name: expected a text in quotes, got ["));
}

TEST_F(HostileFiles, LongNamesAreShownShortened) {
  const std::string name(500'000, 'x');
  EXPECT_THAT(error_of_model(name + " = 1\n"), AllOf(StartsWith("m.toml:1: xxxx"), HasSubstr("...: unknown key; known here: ")));
  EXPECT_THAT(error_of_model("coordinates = [\"" + name + "?\"]\n"), HasSubstr("xxx..."));
}

TEST_F(HostileFiles, DeepArraysTablesAndKeysAreRefused) {
  const std::string too_deep = "m.toml:2: arrays and tables are nested deeper than 32";
  EXPECT_EQ(error_of_model("# [[[\nlatent = " + std::string(100'000, '[')), too_deep);
  EXPECT_EQ(error_of_model("name = '[['\nlatent = " + std::string(33, '[') + std::string(33, ']')), too_deep);
  EXPECT_EQ(error_of_model("name = \"\"\"a\\\"\"\"\"\"\nlet = " + repeated("{a = ", 100'000)), too_deep);
  const std::string too_many_dots = "m.toml:3: a key with more than 16 dots";
  EXPECT_EQ(error_of_model("\n\na" + repeated(".a", 400'000) + " = 1\n"), too_many_dots);
  EXPECT_EQ(error_of_model("\n\n[a" + repeated(" . \"b\"", 100'000) + "]\n"), too_many_dots);
  EXPECT_EQ(error_of_model("x = '''\n'[[''''\n{ a = '''''', b" + repeated(".b", 17) + " = 1 }\n"), too_many_dots);
  // the same in texts, comments and numbers is no nesting
  const std::string harmless = "name = \"" + repeated("[.", 50) + "\" # " + repeated("[.", 50) + "\n";
  EXPECT_EQ(error_of_model(harmless + model_with_force("q1")), "");
  EXPECT_THAT(error_of_model("noise.ddq = [" + repeated("1.5, ", 1000) + "]\n"), HasSubstr("coordinates: missing"));
}

TEST_F(HostileFiles, WhatTheTomlParserOnlyAssertsIsRefused) {
  for (const char* text : {"[=]", "[\x0f]", "[[ ,]]", "[\n]"}) EXPECT_EQ(error_of_model(text), "m.toml: not valid TOML") << text;
  EXPECT_EQ(error_of_model("# é\n[é]"), "m.toml:2: letters beyond ASCII stand in quotes and comments only");
  // toml++ looks for white space behind a backslash at the end of a line, and for the end of a number
  EXPECT_EQ(error_of_model("name = \"\"\"a\\\n é\"\"\"\n" + model_with_force("q1")), "");
  EXPECT_THAT(error_of_model("name = 1\"é\""), HasSubstr("m.toml:1: "));
}

TEST_F(HostileFiles, ALargeModelFileIsRefusedBeforeItIsRead) {
  const test::TemporaryFolder folder;
  const std::filesystem::path path = folder.write("big.toml", "");
  std::filesystem::resize_file(path, 100'000'000);
  EXPECT_EQ(input_error_of([&] { static_cast<void>(Model::read(path)); }),
            path.string() + ": 100000000 bytes; a model file has at most 1048576");
}

// ------------------------------------------------------------------------------------------------------------------------ a fit

TEST_F(HostileFiles, DeepBracketsInAFitAreRefused) {
  for (const std::string& deep : {std::string(100'000, '['), std::string(100'000, '[') + std::string(100'000, ']')}) {
    EXPECT_THAT(error_of_fit(deep), StartsWith("fit.json: "));
    const std::string model = R"({"name": "m", "text": "robot = 'r'", "robot": )" + deep + "}";
    EXPECT_THAT(error_of_fit(R"({"format": "gp2 fit", "version": 1, "model": )" + model + "}"), StartsWith("fit.json: "));
  }
}

TEST_F(HostileFiles, AFitOfManyKeysIsRefused) {
  std::string keys = "{";
  for (int k = 0; k < 200'000; ++k) keys += fmt::format("\"{}\":0,", k);
  keys += "\"format\":\"gp2 fit\",\"version\":1}";
  EXPECT_THAT(error_of_fit(keys), StartsWith("fit.json: not a whole fit file: "));
}

TEST_F(HostileFiles, AFitDoesNotReadTheRobotThatItsTextNames) {
  const char* text = R"({"format": "gp2 fit", "version": 1, "model": {"name": "m.toml", "text": "robot = '/dev/zero'"}})";
  EXPECT_EQ(error_of_fit(text), "fit.json: m.toml:1: robot: the fit does not hold the robot of '/dev/zero'");
}

// ------------------------------------------------------------------------------------------------------------------------ a log

TEST_F(HostileFiles, ALineOfAHundredMegabytesIsRefused) {
  const std::string line(100'000'000, 'x');
  EXPECT_EQ(error_of_csv(line + "\n1\n"),
            "log.csv:1: the name of column 1 has 100000000 bytes, at most 1000 are allowed: is this no table? It begins '" +
                std::string(57, 'x') + "...'");
  EXPECT_EQ(error_of_csv("q1\n" + line + "\n"),
            "log.csv:2: column 'q1': '" + std::string(57, 'x') + "...' is not a finite number");
}

TEST_F(HostileFiles, AMillionColumnsAreRefused) {
  EXPECT_EQ(error_of_csv("q" + repeated(",q", 999'999) + "\n1\n"),
            "log.csv:1: the header has 1000000 columns; at most 10000 are read: split the table, or is it no table?");
  EXPECT_EQ(error_of_csv("q\n" + std::string(999'999, ',') + "\n"),
            "log.csv:2: ragged row: 1000000 cells, but the header has 1 columns");
}

// --------------------------------------------------------------------------------------------------- what is no file

TEST_F(HostileFiles, FoldersDevicesAndPipesInsteadOfFilesAreRefused) {
  const test::TemporaryFolder folder;
  const std::string pipe = (folder / "pipe").string();
  ASSERT_EQ(mkfifo(pipe.c_str(), 0600), 0);
  const std::vector<std::function<void(const std::string&)>> readers = {
      [](const std::string& path) { static_cast<void>(CsvTable::read(path)); },
      [](const std::string& path) { static_cast<void>(Model::read(path)); },
      [](const std::string& path) { static_cast<void>(FitFile::read(path)); }};
  for (const auto& read : readers) {
    const auto error = [&](const std::string& path) { return input_error_of([&] { read(path); }); };
    EXPECT_EQ(error(folder.path().string()), folder.path().string() + ": cannot be read: Is a directory");
    EXPECT_EQ(error(pipe), pipe + ": cannot be read: a pipe that nothing writes to");
    EXPECT_THAT(error("/dev/zero"), AllOf(StartsWith("/dev/zero: more than "), HasSubstr(" bytes, which is all that is read")));
    EXPECT_THAT(error("/dev/null"), StartsWith("/dev/null:"));
  }
}

TEST_F(HostileFiles, AFileThatIsTooLargeIsRefusedBeforeItIsRead) {
  const test::TemporaryFolder folder;
  const std::filesystem::path path = folder.write("log.csv", "");
  std::filesystem::resize_file(path, std::uintmax_t{2} << 40);
  for (const auto& error : {input_error_of([&] { static_cast<void>(CsvTable::read(path)); }),
                            input_error_of([&] { static_cast<void>(FitFile::read(path)); })}) {
    EXPECT_EQ(error, path.string() + ": 2199023255552 bytes; at most 1073741824 are read");
  }
}

}  // namespace
}  // namespace gp2
