#include <algorithm>
#include <functional>
#include <ostream>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "apps/command_line.hpp"
#include "gp2/files/fit_file.hpp"

// Bad input exits with 2, says where, what, and the mend, and leaves every file as it was.
namespace gp2::test {
namespace {

using testing::HasSubstr;

/// One thing wrong, made by `spoil` on a desk where everything is right.
struct BadInput {
  std::string name;  // a sentence
  std::function<void(const Desk&)> spoil;
  std::string line;                // the command that meets it
  std::vector<std::string> texts;  // what it says
};

void PrintTo(const BadInput& one, std::ostream* out) { *out << one.name; }

/// surface.toml with a change, as model.toml.
std::function<void(const Desk&)> model_with(const std::string& from, const std::string& to) {
  return [=](const Desk& desk) { desk.write("model.toml", replaced(desk.read("model.toml"), from, to)); };
}
/// train.csv with a change.
std::function<void(const Desk&)> log_with(const std::function<std::string(const std::string&)>& change) {
  return [=](const Desk& desk) { desk.write("train.csv", change(desk.read("train.csv"))); };
}
/// The first cell of line `number` changed.
std::function<void(const Desk&)> log_with_cell(int number, const std::string& cell) {
  return log_with([=](const std::string& log) {
    std::size_t start = 0;
    for (int line = 1; line < number; ++line) start = log.find('\n', start) + 1;
    return log.substr(0, start) + cell + log.substr(log.find(',', start));
  });
}
void nothing(const Desk&) {}

const std::string fit_line = "gp2 fit model.toml --data train.csv --max-iterations 0 -o old.json";
const std::string predict_line = "gp2 predict fit.json --states train.csv -o old.csv";

const std::string mass = R"(mass  = [["m", "0", "0"], ["0", "m", "0"], ["0", "0", "m"]])";
const std::string constraint = R"(position = ["p1*q1^2 + p2*q2^2 + p3*q1*q2 + p4*cos(p5*q1) - q3"])";

const std::vector<BadInput> bad_inputs = {
    // the view
    {"NextVelocityWithoutATimeStep", nothing, predict_line + " --view next-velocity", {"--view next-velocity", "--dt SECONDS"}},
    {"ATimeStepForAnotherView", nothing, predict_line + " --dt 0.1", {"--dt goes with --view next-velocity"}},
    {"ATimeStepBackwards", nothing, predict_line + " --view next-velocity --dt -1", {"--dt", "must be positive", "-1"}},
    {"UnknownLatent", nothing, predict_line + " --latent drag", {"--latent", "'drag'", "there are: unconstrained acceleration"}},
    // the model
    {"UnknownSymbol",
     model_with(R"("u2", "u3 - m*g")", R"("ux2", "u3 - m*g")"),
     fit_line,
     {"model.toml:20", "mechanics.force entry 2", "unknown symbol 'ux2'", "did you mean 'u2'"}},
    {"MassMatrixOfWrongShape",
     model_with(mass, R"(mass = [["m", "0"], ["0", "m"]])"),
     fit_line,
     {"model.toml:19", "mechanics.mass", "expected 3 rows", "got 2"}},
    {"MassMatrixNotSymmetric",
     model_with(mass, R"(mass = [["m", "0.1", "0"], ["0", "m", "0"], ["0", "0", "m"]])"),
     fit_line,
     {"model.toml:19", "mechanics.mass", "not symmetric", "'0.1'", "write the same on both sides"}},
    {"MassMatrixNotPositiveDefinite",
     model_with(mass, R"(mass = [["q1 + 1.5", "0", "0"], ["0", "m", "0"], ["0", "0", "m"]])"),
     fit_line,
     {"train.csv: data row ", "mass matrix M is not positive definite", "gp2 check"}},
    {"AccelerationRowNotLinear",
     model_with(constraint, R"(acceleration = ["ddq1^2 - ddq2"])"),
     fit_line,
     {"model.toml:24", "constraints.acceleration entry 1", "linear", "'ddq1'"}},
    {"ContradictingConstraints",
     model_with(constraint, R"(acceleration = ["ddq1 - q2", "ddq1 - q2 - 1"])"),
     fit_line,
     {"train.csv: data row 1", "contradict each other"}},
    {"NoiseOfZeroInTheModel",
     model_with("ddq = 0.1", "ddq = 0"),
     fit_line,
     {"model.toml:33", "noise.ddq", "must be positive", "got 0"}},
    {"NoiseTooSmallInTheModel",
     model_with("ddq = 0.1", "ddq = 1e-12"),
     fit_line,
     {"model.toml: [noise] ddq", "1e-12", "too small for double precision", "smallest usable value"}},
    {"NoiseTooLarge",
     nothing,
     fit_line + " --noise-std 1e300",
     {"--noise-std", "noise standard deviation 1e+300 of ddq1 is too large", "at most 1e+100"}},
    {"NoNoiseAnywhere", model_with("ddq = 0.1", ""), fit_line, {"model.toml", "noise of ddq1 is not known", "--noise-std"}},
    {"NotToml", model_with("[mechanics]", "[mechanics"), fit_line, {"model.toml:18"}},
    {"ModelAbsent", nothing, "gp2 fit absent.toml --data train.csv -o old.json", {"absent.toml: cannot be read"}},
    // the log
    {"MissingColumn",
     log_with([](const std::string& log) { return replaced(log, ",dq2,", ",other,"); }),
     fit_line,
     {"train.csv", "missing column 'dq2'", "looked for dq2, qd2", "other", "--map LOGNAME=dq2"}},
    {"CellNotANumber", log_with_cell(5, "1.2.3"), fit_line, {"train.csv:5", "column 'q1'", "'1.2.3' is not a finite number"}},
    {"CellNan", log_with_cell(4, "NaN"), fit_line, {"train.csv:4", "column 'q1'", "'NaN' is not a finite number"}},
    {"CellInfinite", log_with_cell(4, "inf"), predict_line, {"train.csv:4", "column 'q1'", "'inf' is not a finite number"}},
    {"CellEmpty", log_with_cell(2, ""), predict_line, {"train.csv:2", "column 'q1'", "the cell is empty"}},
    {"RaggedRow", log_with_cell(6, "1,2"), fit_line, {"train.csv:6", "ragged row: 13 cells", "12 columns"}},
    {"EmptyFile", log_with([](const std::string&) { return ""; }), fit_line, {"train.csv", "the file is empty"}},
    {"NoRows",
     log_with([](const std::string& log) { return log.substr(0, log.find('\n') + 1); }),
     fit_line,
     {"train.csv", "no data rows"}},
    {"Semicolons",
     log_with([](std::string log) {
       std::replace(log.begin(), log.end(), ',', ';');
       return log;
     }),
     fit_line,
     {"train.csv:1", "not separated by commas but by ';'"}},
    {"LogInUtf16",
     log_with([](const std::string& log) {
       std::string wide = "\xff\xfe";
       for (const char c : log) wide += {c, '\0'};
       return wide;
     }),
     fit_line,
     {"train.csv: the text is UTF-16; save it as UTF-8"}},
    {"LogWithAZeroByte",
     log_with([](std::string log) { return log.replace(log.size() / 2, 1, 1, '\0'); }),
     fit_line,
     {"train.csv:", "a zero byte is in no text; the file is damaged, binary, or UTF-16 (iconv -f UTF-16LE -t UTF-8)"}},
    {"LogCompressed",
     log_with([](const std::string& log) { return "\x1f\x8b\x08" + log; }),
     fit_line,
     {"train.csv: the file is compressed by gzip; unpack it first"}},
    {"LogASpreadsheet",
     log_with([](const std::string& log) { return "PK\x03\x04" + log; }),
     fit_line,
     {"train.csv: the file is a ZIP archive, as spreadsheets are; export it as CSV"}},
    {"LogOfAnOldMac",
     log_with([](std::string log) {
       std::replace(log.begin(), log.end(), '\n', '\r');
       return log;
     }),
     fit_line,
     {"train.csv:1: lines end in a carriage return alone", "tr '\\r' '\\n'"}},
    {"ModelInUtf16",
     [](const Desk& desk) { desk.write("model.toml", "\xff\xfe" + desk.read("model.toml")); },
     fit_line,
     {"model.toml: the text is UTF-16"}},
    {"ACoordinateThatIsAColumnOfAnother",
     [](const Desk& desk) {
       desk.write("model.toml",
                  "coordinates = [\"x\", \"x_std\"]\n[mechanics]\nmass = [[1, 0], [0, 1]]\nforce = [\"0\", \"0\"]\n");
     },
     "gp2 check model.toml",
     {"model.toml:1: coordinates: the column x_std would be a name of this model and what logs and predictions call a quantity "
      "of 'x'"}},
    {"SeedTooLarge",
     nothing,
     fit_line + " --seed 18446744073709551616",
     {"--seed", "must be below 2^64, got 18446744073709551616"}},
    {"SeedThatAProgrammerReadsAsOctal", nothing, fit_line + " --seed 010", {"--seed", "expected a whole number, got '010'"}},
    {"RestartsInOctal", nothing, fit_line + " --restarts 010", {"--restarts", "expected a whole number, at most", "got '010'"}},
    {"AnInputThatIsAColumnOfACoordinate",
     [](const Desk& desk) {
       desk.write("model.toml",
                  "coordinates = [\"x\"]\ninputs = [\"force_x\"]\n[mechanics]\nmass = [[1]]\nforce = [\"force_x\"]\n");
     },
     "gp2 check model.toml",
     {"model.toml:2: inputs: the column force_x would be a name of this model and what logs and predictions call a quantity "
      "of 'x'"}},
    {"GenerateInfiniteNoise",
     nothing,
     "gp2 generate model.toml --n 5 --noise-std inf -o old.csv",
     {"--noise-std: must be 0 … 1e+100, got inf"}},
    {"OutputThroughALinkToNowhere",
     [](const Desk& desk) { std::filesystem::create_symlink("absent/target.csv", desk / "link.csv"); },
     "gp2 predict fit.json --states train.csv -o link.csv",
     {"link.csv: cannot be written: No such file or directory"}},
    {"LogAbsent", nothing, "gp2 fit model.toml --data absent.csv -o old.json", {"absent.csv: cannot be read"}},
    // options
    {"NoiseTooSmall", nothing, fit_line + " --noise-std 1e-12", {"--noise-std", "1e-12", "too small", "smallest usable value"}},
    {"EstimateUnknown", nothing, fit_line + " --estimate p1,p9", {"--estimate", "'p9'", "it has: m, g, p1"}},
    {"ObserveUnknown", nothing, fit_line + " --observe ddq1,ddq4", {"--observe", "'ddq4'", "it has: ddq1, ddq2, ddq3"}},
    {"ObserveTwice", nothing, fit_line + " --observe ddq1,ddq1", {"--observe", "'ddq1' stands twice"}},
    {"OutputsUnknown", nothing, "gp2 evaluate fit.json --data train.csv --outputs ddq4", {"--outputs", "'ddq4'"}},
    {"FolderAbsent",
     nothing,
     "gp2 fit model.toml --data train.csv -o absent/fit.json",
     {"absent/fit.json", "no folder 'absent'"}},
    {"OutputIsAFolder", nothing, "gp2 predict fit.json --states train.csv -o models", {"models: cannot be written"}},
    {"FitToAFolder", nothing, "gp2 fit model.toml --data train.csv -o models", {"models: cannot be written: Is a directory"}},
    {"OutputIsTheStates",
     nothing,
     "gp2 predict fit.json --states train.csv -o ./train.csv",
     {"-o ./train.csv", "that is the input train.csv, which would be lost", "write to another file"}},
    {"OutputIsTheModel", nothing, "gp2 generate model.toml --n 5 -o model.toml", {"that is the input model.toml"}},
    {"OutputIsTheLogOfAFit", nothing, "gp2 fit model.toml --data train.csv -o train.csv", {"that is the input train.csv"}},
    {"OutputIsTheKnowledgeOfAFit",
     nothing,
     "gp2 fit model.toml --data train.csv --also unconstrained:old.csv -o old.csv",
     {"that is the input old.csv"}},
    {"OutputIsTheLogOfDerive", nothing, "gp2 derive train.csv --model model.toml -o train.csv", {"that is the input train.csv"}},
    {"OutputIsTheFitOfSimulate",
     nothing,
     "gp2 simulate fit.json --start q1=0 --t-end 1 -o fit.json",
     {"that is the input fit.json"}},
    {"OutputIsTheFitOfReport", nothing, "gp2 report fit.json -o fit.json", {"that is the input fit.json"}},
    {"DiskFull",
     nothing,
     "gp2 predict fit.json --states train.csv -o /dev/full",
     {"/dev/full: cannot be written: No space left on device"}},
    {"FileTooLarge",
     nothing,
     "ulimit -f 1; gp2 generate model.toml --n 500 -o old.csv",
     {"old.csv: cannot be written: File too large"}},
    {"StandardOutputFullHalfWay",
     nothing,
     "gp2 show model.toml --full --latex > /dev/full",
     {"standard output: cannot be written: No space left on device"}},
    {"StandardOutputFull",
     nothing,
     "gp2 show model.toml > /dev/full",
     {"standard output: cannot be written: No space left on device"}},
    {"AnEmptyList", nothing, fit_line + " --observe ''", {"--observe: expected a value such as", "got ''"}},
    {"AnEmptyNumber", nothing, fit_line + " --max-points ''", {"--max-points: expected a value such as N"}},
    {"GenerateNone", nothing, "gp2 generate model.toml --n 0 -o old.csv", {"--n: must be positive, got 0"}},
    {"GenerateNegativeNoise",
     nothing,
     "gp2 generate model.toml --n 5 --noise-std -1 -o old.csv",
     {"--noise-std: must be 0 … 1e+100, got -1"}},
    {"GenerateWithoutTruth", model_with("[truth]", "[unused]"), "gp2 generate model.toml --n 5 -o old.csv", {"model.toml"}},
    // the fit
    {"FitOfANewerFormat",
     [](const Desk& desk) {
       desk.write("fit.json",
                  replaced(desk.read("fit.json"), fmt::format("\"version\": {}", FitFile::format_version), R"("version": 99)"));
     },
     predict_line,
     {"fit.json", "format 99", "use a newer gp2"}},
    {"FitChangedByHand",
     [](const Desk& desk) {
       desk.write("fit.json", replaced(desk.read("fit.json"), R"("raw_angles": false)", R"("raw_angles": true)"));
     },
     predict_line,
     {"fit.json", "changed after gp2 wrote it", R"(if the change is meant, set "checksum": ")"}},
    {"FitCutShort",
     [](const Desk& desk) { desk.write("fit.json", desk.read("fit.json").substr(0, 3000)); },
     predict_line,
     {"fit.json", "cut short", "gp2 fit"}},
    {"FitCutShortWhenEvaluated",
     [](const Desk& desk) { desk.write("fit.json", desk.read("fit.json").substr(0, 3000)); },
     "gp2 evaluate fit.json --data train.csv --json",
     {"fit.json", "cut short"}},
    {"ModelInPlaceOfAFit",
     nothing,
     "gp2 predict model.toml --states train.csv -o old.csv",
     {"model.toml: not valid JSON but a model file, by its name: a FIT.json is wanted here"}},
    {"LogInPlaceOfAFit", nothing, fit_line + " --start train.csv", {"train.csv: not valid JSON but a table, by its name"}},
    {"FitInPlaceOfAModel", nothing, "gp2 check fit.json", {"fit.json: not valid TOML but JSON", "a model file is wanted here"}},
    {"LogInPlaceOfAModel",
     nothing,
     "gp2 check train.csv",
     {"train.csv: not valid TOML but a table, by its name: a model file is"}},
    {"FitInPlaceOfALog",
     nothing,
     "gp2 evaluate fit.json --data fit.json",
     {"fit.json:1: not a table but JSON, as gp2 fit writes it"}},
    {"ModelInPlaceOfALog",
     nothing,
     "gp2 check model.toml --data model.toml",
     {"not a table but a model file, by its name: a CSV log is"}},
    {"OptionTwice", nothing, predict_line + " --cov std --cov none", {"error: --cov is given twice"}},
    {"OptionInPlaceOfAValue",
     nothing,
     "gp2 predict fit.json --cov -o old.csv --states train.csv",
     {"error: --cov: its value is missing"}},
    {"OutputInPlaceOfAValue", nothing, "gp2 plot fit.json -o --what force", {"error: -o: its value is missing"}},
    {"NoWholeNumber", nothing, fit_line + " --restarts 1e300", {"--restarts: expected a whole number", "got '1e300'"}},
    {"NoOutput", nothing, "gp2 predict fit.json --states train.csv", {"error: -o (--output) is required"}},
    {"MoreSamplesThanMemory",
     nothing,
     predict_line + " --samples 1000000000",
     {"--samples: 1000000000 samples of 20 rows together take", "GB are free", "samples would fit"}},
    {"NotAFit", nothing, "gp2 predict other.json --states train.csv -o old.csv", {"other.json", "not a fit"}},
    {"PredictMissingColumn",
     log_with([](const std::string& log) { return replaced(log, ",u3,", ",other,"); }),
     predict_line,
     {"train.csv", "missing column 'u3'"}},
};

class BadInputTo : public testing::TestWithParam<BadInput> {};

TEST_P(BadInputTo, IsRefusedWithItsPlaceAndItsMend) {
  const Desk desk;
  desk.write("model.toml", desk.read("models/surface.toml"));
  desk.done("gp2 generate model.toml --n 20 -o train.csv");
  desk.done("gp2 fit model.toml --data train.csv --max-iterations 0 -o fit.json");
  desk.write("old.json", "what was here before\n");
  desk.write("old.csv", "what was here before\n");
  desk.write("other.json", "{}\n");
  GetParam().spoil(desk);
  const auto files = [&] {
    std::vector<std::string> names;
    for (const auto& entry : std::filesystem::directory_iterator(desk.path())) names.push_back(entry.path().filename());
    std::sort(names.begin(), names.end());
    return names;
  };
  const std::vector<std::string> before = files();

  const Outcome outcome = desk.run(GetParam().line);
  EXPECT_EQ(outcome.status, 2) << outcome.err;
  EXPECT_EQ(outcome.out, "");
  EXPECT_THAT(outcome.err, testing::StartsWith("gp2: "));
  for (const std::string& text : GetParam().texts) EXPECT_THAT(outcome.err, HasSubstr(text));
  EXPECT_EQ(desk.read("old.json"), "what was here before\n");
  EXPECT_EQ(desk.read("old.csv"), "what was here before\n");
  EXPECT_EQ(files(), before);  // nothing half-written is left
}

INSTANTIATE_TEST_SUITE_P(TheCommand, BadInputTo, testing::ValuesIn(bad_inputs), [](const auto& one) { return one.param.name; });

TEST(Edges, ALinkLeadsToTheFileThatIsMade) {
  const Desk desk;
  std::filesystem::create_directory(desk / "there");
  std::filesystem::create_symlink("there/log.csv", desk / "link.csv");
  std::filesystem::create_symlink("link.csv", desk / "chain.csv");
  desk.done("gp2 generate models/surface.toml --n 5 -o chain.csv");
  EXPECT_TRUE(std::filesystem::is_symlink(desk / "link.csv"));
  EXPECT_TRUE(std::filesystem::is_symlink(desk / "chain.csv"));
  EXPECT_EQ(desk.table("there/log.csv").n_rows(), 5);
}

TEST(Edges, AnAtSignMayBePartOfAPath) {
  const Desk desk;
  std::filesystem::create_directory(desk / "me@home");
  desk.write("me@home/model.toml", desk.read("models/surface.toml"));
  desk.done("gp2 generate models/surface.toml --n 10 -o me@home/log.csv");
  for (const char* data : {"me@home/log.csv", "me@home/log.csv@models/surface.toml", "me@home/log.csv@me@home/model.toml"}) {
    desk.done(std::string("gp2 fit models/surface.toml --max-iterations 0 -o fit.json --data ") + data);
  }
  const Outcome absent =
      desk.run("gp2 fit models/surface.toml --max-iterations 0 -o fit.json --data me@home/log.csv@absent.toml");
  EXPECT_THAT(absent.err, HasSubstr("absent.toml: cannot be read"));
}

TEST(Edges, AReportShowsNumbersBelowTheNormalOnes) {
  const Desk desk;
  std::string log = "q1,q2,q3,dq1,dq2,dq3,u1,u2,u3,ddq1,ddq2,ddq3\n";
  desk.done("gp2 generate models/surface.toml --n 10 -o train.csv");
  const CsvTable table = desk.table("train.csv");
  for (int row = 0; row < table.n_rows(); ++row) {
    for (int column = 0; column < table.n_columns(); ++column) {
      // one velocity is as small as a number can be
      const bool is_tiny = row == 0 && table.header()[static_cast<std::size_t>(column)] == "dq1";
      const std::string cell = is_tiny ? "4e-320" : table.cell(row, column);
      log += cell + (column + 1 < table.n_columns() ? "," : "\n");
    }
  }
  desk.write("tiny.csv", log);
  desk.done("gp2 fit models/surface.toml --data tiny.csv --max-iterations 0 -o fit.json");
  desk.done("gp2 report fit.json -o report.html");
}

/// A mass that is negative where q1 is.
constexpr const char* variable_mass = R"(
name = "particle"
coordinates = ["q1", "q2"]
[mechanics]
mass = [["q1", "0"], ["0", "1"]]
force = ["0", "0"]
[constraints]
acceleration = ["ddq2"]
[[latent]]
name = "force"
kernel = "se"
features = ["q1", "q2"]
directions = "acceleration"
[noise]
ddq = 0.1
)";

TEST(BadRow, IsNamedByItsPlaceInTheLogAlsoAfterAShuffle) {
  const Desk desk;
  std::string csv = "q1,q2,ddq1,ddq2\n";
  for (int row = 1; row <= 20; ++row) csv += (row == 13 ? "-1" : "1") + std::string(",0,0.1,0\n");
  desk.write("log.csv", csv);
  desk.write("model.toml", variable_mass);
  int n_refused = 0;
  for (int seed = 0; seed < 6; ++seed) {
    const Outcome outcome = desk.run("gp2 fit model.toml --data log.csv --max-points 10 --max-iterations 0 -o fit.json --seed " +
                                     std::to_string(seed));
    if (outcome.status == 0) continue;
    EXPECT_THAT(outcome.err, HasSubstr("log.csv: data row 13: the mass matrix M is not positive definite"));
    ++n_refused;
  }
  EXPECT_GT(n_refused, 0);
  EXPECT_LT(n_refused, 6);
}

TEST(BadRow, IsNamedWhenPredictionsFailThere) {
  const Desk desk;
  desk.write("model.toml", variable_mass);
  desk.write("log.csv", "q1,q2,ddq1,ddq2\n1,0,0.1,0\n2,0,0.3,0\n3,0,0.2,0\n");
  desk.done("gp2 fit model.toml --data log.csv --max-iterations 0 -o fit.json");
  desk.write("states.csv", "q1,q2,ddq1,ddq2\n1,0,0.1,0\n-2,0,0.3,0\n");
  for (const char* line : {"gp2 predict fit.json --states states.csv -o prediction.csv",
                           "gp2 predict fit.json --states states.csv --view unconstrained --cov full -o prediction.csv",
                           "gp2 evaluate fit.json --data states.csv"}) {
    const Outcome outcome = desk.run(line);
    EXPECT_EQ(outcome.status, 2);
    EXPECT_THAT(outcome.err, HasSubstr("states.csv: "));
    EXPECT_THAT(outcome.err, HasSubstr("the mass matrix M is not positive definite at state 2 (q1 = -2"));
    EXPECT_FALSE(desk.has("prediction.csv"));
  }
}

}  // namespace
}  // namespace gp2::test
