#include "gp2/data/csv.hpp"

#include <bit>
#include <cmath>
#include <csignal>
#include <fstream>
#include <limits>
#include <random>
#include <thread>

#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <fmt/format.h>
#include <gmock/gmock.h>

#include "base/checksum.hpp"
#include "gp2/error.hpp"
#include "io_testing.hpp"
#include "thread_ranks.hpp"

namespace gp2 {
namespace {

using test::input_error_of;
using test::TemporaryFolder;
using testing::ElementsAre;
using testing::EndsWith;
using testing::HasSubstr;
using testing::StartsWith;

TEST(CsvFile, IsKnownByItsSizeAndChecksum) {
  const TemporaryFolder folder;
  const auto path = folder.write("log.csv", "x,y\n1,2\n\n3,4");
  const CsvTable table = CsvTable::read(path, CsvTable::Keep::numbers);
  ASSERT_TRUE(table.file());
  EXPECT_EQ(table.file()->name, path.string());
  EXPECT_EQ(table.file()->bytes, 12U);
  EXPECT_EQ(table.file()->rows, 2);
  EXPECT_EQ(table.file()->checksum, checksum("x,y\n1,2\n\n3,4"));
  EXPECT_FALSE(table.first_rows(1).file());
  EXPECT_FALSE(CsvTable::parse("x\n1\n", "text").file());
}

CsvTable parse(std::string_view text) { return CsvTable::parse(text, "log.csv"); }

CsvTable from_cells(std::vector<std::string> header, std::vector<std::string> cells) {
  return CsvTable::from_cells("frame", std::move(header), std::move(cells));
}

/// The number in the only cell of a column x.
double number_in(const std::string& cell) { return parse("x,y\n" + cell + ",0\n").number(0, 0); }

// ---- tables

TEST(Csv, ReadsNamesAndNumbers) {
  const CsvTable table = parse("q1,q2\n1,2\n-3.5e-2,4\n");
  EXPECT_EQ(table.name(), "log.csv");
  EXPECT_THAT(table.header(), ElementsAre("q1", "q2"));
  EXPECT_EQ(table.n_rows(), 2);
  EXPECT_EQ(table.n_columns(), 2);
  EXPECT_EQ(table.number(1, 0), -3.5e-2);
  EXPECT_EQ(table.cell(1, 0), "-3.5e-2");
  EXPECT_EQ(table.find("q2"), 1);
  EXPECT_EQ(table.find("q3"), -1);
}

TEST(Csv, LineEndingsAByteOrderMarkAndSpacesDoNotMatter) {
  for (const char* text : {"q1,q2\n1,2\n", "q1,q2\n1,2", "q1,q2\r\n1,2\r\n", "q1,q2\r\n1,2", "\xef\xbb\xbfq1,q2\n1,2\n",
                           " q1 ,\tq2\n 1 , 2 \n", "\n\nq1,q2\n\n1,2\n\n"}) {
    const CsvTable table = parse(text);
    EXPECT_THAT(table.header(), ElementsAre("q1", "q2")) << text;
    ASSERT_EQ(table.n_rows(), 1) << text;
    EXPECT_EQ(table.number(0, 0), 1) << text;
    EXPECT_EQ(table.number(0, 1), 2) << text;
  }
}

TEST(Csv, QuotedCellsMayHoldCommasAndQuotes) {
  const CsvTable table = parse("\"q1\", \"remark, long\" \n\"1.5\",\"he said \"\"no\"\", twice\"\n2,\"\"\n");
  EXPECT_THAT(table.header(), ElementsAre("q1", "remark, long"));
  EXPECT_EQ(table.number(0, 0), 1.5);
  EXPECT_EQ(table.cell(0, 1), "he said \"no\", twice");
  EXPECT_EQ(table.cell(1, 1), "");
}

TEST(Csv, AQuoteThatIsNotClosedIsRefused) {
  EXPECT_THAT(input_error_of([] { parse("q1,q2\n\"1,2\n"); }), StartsWith("log.csv:2: a quote \" is not closed"));
  EXPECT_THAT(input_error_of([] { parse("q1,q2\n\"1\"x,2\n"); }), StartsWith("log.csv:2: a quote \" is not closed"));
}

TEST(Csv, ARaggedRowIsRefusedWithItsLineInTheFile) {
  EXPECT_EQ(input_error_of([] { parse("q1,q2\n1,2\n\n3\n"); }), "log.csv:4: ragged row: 1 cells, but the header has 2 columns");
  EXPECT_EQ(input_error_of([] { parse("q1,q2\n1,2,3\n"); }), "log.csv:2: ragged row: 3 cells, but the header has 2 columns");
  EXPECT_EQ(input_error_of([] { parse("q1,q2\n1,2,\n"); }), "log.csv:2: ragged row: 3 cells, but the header has 2 columns");
  EXPECT_EQ(input_error_of([] { parse("# of Monday\nq1,q2\n1,2\n"); }),
            "log.csv:2: ragged row: 2 cells, but the header has 1 columns: a line that begins with # is not read as a comment; "
            "remove it");
  EXPECT_THAT(input_error_of([] { parse("q1,q2\n# paused\n1,2\n"); }),
              testing::AllOf(StartsWith("log.csv:2: ragged row: 1 cells"), EndsWith("is not read as a comment; remove it")));
}

TEST(Csv, AHeaderWithoutNamesOrWithOneNameTwiceIsRefused) {
  EXPECT_EQ(input_error_of([] { parse("q1,q2,q1\n1,2,3\n"); }),
            "log.csv:1: the column 'q1' stands twice in the header; rename or remove one");
  EXPECT_EQ(input_error_of([] { parse("\nq1,,q2\n1,2,3\n"); }),
            "log.csv:2: column 2 of the header has no name; name it, or remove a comma too many");
  EXPECT_THAT(input_error_of([] { parse("q1,q2,\n1,2,\n"); }), HasSubstr("column 3 of the header has no name"));
}

TEST(Csv, OtherSeparatorsAreRefusedByName) {
  EXPECT_THAT(input_error_of([] { parse("q1;q2\n1,5;2\n"); }), HasSubstr("not separated by commas but by ';'"));
  EXPECT_THAT(input_error_of([] { parse("q1\tq2\n1\t2\n"); }), HasSubstr("not separated by commas but by 'tab'"));
  EXPECT_THAT(input_error_of([] { parse("t q1 q2\n0 1 2\n"); }), HasSubstr("not separated by commas but by 'space'"));
}

TEST(Csv, AFileWithoutDataIsRefused) {
  EXPECT_EQ(input_error_of([] { parse(""); }), "log.csv: the file is empty; expected a header line and data rows");
  EXPECT_EQ(input_error_of([] { parse("\n \r\n"); }), "log.csv: the file is empty; expected a header line and data rows");
  EXPECT_EQ(input_error_of([] { parse("\xef\xbb\xbf"); }), "log.csv: the file is empty; expected a header line and data rows");
  EXPECT_EQ(input_error_of([] { parse("q1,q2\n"); }), "log.csv: no data rows after the header");
}

TEST(Csv, AColumnWithoutAnyNumberIsText) {
  const CsvTable table = parse("label,x,y\na,1,\n,b,\n");
  EXPECT_TRUE(table.is_text(0));
  EXPECT_FALSE(table.is_text(1));
  EXPECT_FALSE(table.is_text(2));
}

TEST(Csv, TheFirstRowsAreATableOfTheirOwn) {
  const CsvTable table = parse("q1,q2\n1,2\n\n3,x\n5,6\n");
  const CsvTable first = table.first_rows(2);
  EXPECT_EQ(first.name(), "log.csv");
  EXPECT_THAT(first.header(), ElementsAre("q1", "q2"));
  ASSERT_EQ(first.n_rows(), 2);
  EXPECT_EQ(first.number(0, 1), 2);
  EXPECT_EQ(first.number(1, 0), 3);
  EXPECT_EQ(first.find("q2"), 1);
  // lines are still those of the file
  EXPECT_EQ(input_error_of([&] { static_cast<void>(first.number(1, 1)); }), "log.csv:4: column 'q2': 'x' is not a finite number");
  EXPECT_EQ(table.n_rows(), 3);
}

TEST(Csv, TheFirstRowsAreNoMoreThanThereAre) {
  const CsvTable table = parse("q1\n1\n2\n");
  for (const int n : {2, 3, 1000000}) {
    const CsvTable first = table.first_rows(n);
    ASSERT_EQ(first.n_rows(), 2) << n;
    EXPECT_EQ(first.number(1, 0), 2);
  }
  for (const int n : {0, -1}) {
    EXPECT_EQ(table.first_rows(n).n_rows(), 0) << n;
    EXPECT_EQ(table.first_rows(n).n_columns(), 1) << n;
  }
}

TEST(Csv, IsMadeOfCellsToo) {
  const CsvTable table = from_cells({"q1", "q2"}, {"1", "2", "-3.5e-2", "nan"});
  EXPECT_EQ(table.n_rows(), 2);
  EXPECT_EQ(table.number(1, 0), -3.5e-2);
  EXPECT_EQ(input_error_of([&] { static_cast<void>(table.number(1, 1)); }),
            "frame: row 2, column 'q2': 'nan' is not a finite number");
}

TEST(Csv, RefusesCellsThatAreNoTable) {
  EXPECT_EQ(input_error_of([] { static_cast<void>(from_cells({}, {"1"})); }), "frame: there are no columns");
  EXPECT_EQ(input_error_of([] { static_cast<void>(from_cells({"q1"}, {})); }), "frame: there are no rows");
  EXPECT_EQ(input_error_of([] {
              static_cast<void>(from_cells({"q1", "q2"}, {"1", "2", "3"}));
            }),
            "frame: 3 cells do not make rows of 2 columns");
  EXPECT_THAT(input_error_of([] {
                static_cast<void>(from_cells({"q1", "q1"}, {"1", "2"}));
              }),
              HasSubstr("the column 'q1' stands twice"));
}

TEST(Csv, IsMadeOfColumnsOfNumbersWithoutPrintingThem) {
  const double nan = std::numeric_limits<double>::quiet_NaN(), infinity = std::numeric_limits<double>::infinity();
  const CsvTable table = CsvTable::from_columns("frame", {{"x", {0.1, nan, -infinity}}, {"label", {}, {"007", "", "late"}}});
  EXPECT_EQ(table.n_rows(), 3);
  EXPECT_EQ(table.number(0, 0), 0.1);
  EXPECT_TRUE(std::isnan(table.number_or_empty(1, 0)));
  EXPECT_TRUE(std::isnan(table.number_or_nan(2, 0)));
  EXPECT_EQ(input_error_of([&] { static_cast<void>(table.number(2, 0)); }),
            "frame: row 3, column 'x': '-inf' is not a finite number");
  EXPECT_EQ(table.number(0, 1), 7);
  EXPECT_EQ(table.cell(0, 1), "007");
  EXPECT_EQ(table.text(), "x,label\n0.1,007\n,\n-inf,late\n");
  EXPECT_EQ(table.take({2, 0}).text(), "x,label\n-inf,late\n0.1,007\n");
}

TEST(Csv, CountsRowsFrom1WhereThereAreNoLines) {
  const CsvTable columns = CsvTable::from_columns("frame", {{"x", {1, 2, 3}}}), lines = parse("x\n1\n\n2\n");
  EXPECT_FALSE(columns.has_lines());
  EXPECT_TRUE(lines.has_lines());
  EXPECT_EQ(columns.take({2}).place(0, 0), "frame: row 3, column 'x'");
  EXPECT_EQ(columns.renamed("other").place(1, 0), "other: row 2, column 'x'");
  EXPECT_EQ(lines.renamed("other").place(1, 0), "other:4: column 'x'");
  EXPECT_EQ(lines.without_lines().place(1, 0), "log.csv: row 2, column 'x'");
}

TEST(Csv, WritesNoCellThatWouldNotReadBack) {
  const CsvTable table = CsvTable::from_columns("frame", {{"x", {1}}, {"note", {}, {"two\nlines"}}});
  EXPECT_THAT(input_error_of([&] { static_cast<void>(table.text()); }), HasSubstr("'two\nlines' has a line break in it"));
}

TEST(Csv, RefusesColumnsThatAreNoTable) {
  EXPECT_EQ(input_error_of([] { CsvTable::from_columns("frame", {}); }), "frame: there are no columns");
  EXPECT_EQ(input_error_of([] { CsvTable::from_columns("frame", {{"x", {}}}); }), "frame: there are no rows");
  EXPECT_EQ(input_error_of([] {
              CsvTable::from_columns("frame", {{"x", {1, 2}}, {"y", {}, {"a"}}});
            }),
            "frame: the columns differ in length: 'x' has 2, 'y' has 1");
}

TEST(Csv, KeepsEveryCellAsItIsWrittenOrNumbersAlone) {
  const std::string text = "x,\"a, b\"\n1.50, 007\nnan,\n+2,\"1e400\"\n\" \",far\n";
  const CsvTable whole = parse(text), lean = CsvTable::parse(text, "log.csv", CsvTable::Keep::numbers);
  EXPECT_EQ(whole.text(), "x,\"a, b\"\n1.50,007\nnan,\n+2,1e400\n\" \",far\n");
  EXPECT_EQ(lean.text(), "x,\"a, b\"\n1.5,7\nnan,\n2,1e400\n\" \",far\n");
  EXPECT_EQ(lean.take({3, 1, 0}).text(), "x,\"a, b\"\n\" \",far\nnan,\n1.5,7\n");
  for (int row = 0; row < whole.n_rows(); ++row) {
    for (int column = 0; column < whole.n_columns(); ++column) {
      EXPECT_EQ(whole.is_empty(row, column), lean.is_empty(row, column));
      const auto outcome = [&](const CsvTable& table) {
        double value = 0;
        const std::string error = input_error_of([&] { value = table.number(row, column); });
        return std::pair(value, error);
      };
      EXPECT_EQ(outcome(whole), outcome(lean));
    }
  }
}

// ---- numbers

TEST(Csv, NumbersMayHaveASignAnExponentAndSpacesInQuotes) {
  EXPECT_EQ(number_in("+1.5"), 1.5);
  EXPECT_EQ(number_in("-1.5E+3"), -1500);
  EXPECT_EQ(number_in(".5"), 0.5);
  EXPECT_EQ(number_in("5."), 5);
  EXPECT_EQ(number_in("\" 7 \""), 7);
  EXPECT_EQ(number_in("5e-324"), std::numeric_limits<double>::denorm_min());
  EXPECT_TRUE(std::signbit(number_in("-0")));
}

TEST(Csv, WhatIsNoFiniteNumberIsRefusedWithLineAndColumn) {
  for (const char* cell : {"inf", "-inf", "+inf", "nan", "NaN", "Infinity", "abc", "1.5x", "1 5", "++1", "+-1", "-+1", "+", "-",
                           "0x10", "1e", "--", "1,5"}) {
    const std::string text = std::string("x,y\n0,0\n\"") + cell + "\",0\n";
    const CsvTable table = parse(text);
    EXPECT_EQ(input_error_of([&] { static_cast<void>(table.number(1, 0)); }),
              std::string("log.csv:3: column 'x': '") + cell + "' is not a finite number");
  }
}

TEST(Csv, AnEmptyCellIsRefusedOnlyWhenItIsAskedFor) {
  const CsvTable table = parse("x,y\n1,\n");
  EXPECT_EQ(table.number(0, 0), 1);
  EXPECT_EQ(input_error_of([&] { static_cast<void>(table.number(0, 1)); }),
            "log.csv:2: column 'y': the cell is empty; a number is needed here");
}

TEST(Csv, NumbersBeyondDoublesAreRefusedAsSuch) {
  for (const char* cell : {"1e400", "-1e400", "1e-400"}) {
    EXPECT_THAT(input_error_of([&] { number_in(cell); }), HasSubstr("does not fit a double")) << cell;
  }
}

TEST(Csv, TheShortestTextOfRandomBitsReadsBackToTheSameBits) {
  std::mt19937_64 random(1);
  std::string text = "x\n";
  std::vector<double> values;
  while (values.size() < 100000) {
    const auto value = std::bit_cast<double>(random());
    if (!std::isfinite(value)) continue;
    values.push_back(value);
    text += shortest(value) + "\n";
  }
  const CsvTable table = parse(text);
  for (std::size_t k = 0; k < values.size(); ++k) {
    const double read = table.number(static_cast<int>(k), 0);
    ASSERT_EQ(std::bit_cast<std::uint64_t>(read), std::bit_cast<std::uint64_t>(values[k])) << table.cell(static_cast<int>(k), 0);
  }
}

TEST(Csv, TheShortestTextIsShort) {
  EXPECT_EQ(shortest(0.1), "0.1");
  EXPECT_EQ(shortest(-2), "-2");
  EXPECT_EQ(shortest(1e300), "1e+300");
  EXPECT_EQ(shortest(-std::numeric_limits<double>::denorm_min()), "-5e-324");
}

// ---- files

TEST(Csv, AFileThatCannotBeReadIsNamedWithTheReason) {
  const TemporaryFolder folder;
  EXPECT_EQ(input_error_of([&] { CsvTable::read(folder / "none.csv"); }),
            (folder / "none.csv").string() + ": cannot be read: No such file or directory");
  EXPECT_EQ(input_error_of([&] { CsvTable::read(folder.path()); }), folder.path().string() + ": cannot be read: Is a directory");
  // a read that fails half way
  EXPECT_EQ(input_error_of([] { CsvTable::read("/proc/self/mem"); }), "/proc/self/mem: cannot be read: Input/output error");
  if (geteuid() != 0) {
    const auto secret = folder.write("secret.csv", "q1\n1\n");
    chmod(secret.c_str(), 0);
    EXPECT_THAT(input_error_of([&] { CsvTable::read(secret); }), EndsWith(": cannot be read: Permission denied"));
  }
}

TEST(Csv, AFileReadsBackAsItWasWritten) {
  const TemporaryFolder folder;
  std::string content = "q1,q2\n";
  for (int k = 0; k < 100000; ++k) content += "0.125,-7\n";
  content += std::string("\0\r\xff", 3);
  write_file(folder / "log.csv", content);
  EXPECT_EQ(read_file(folder / "log.csv"), content);
  write_file(folder / "log.csv", "");
  EXPECT_EQ(read_file(folder / "log.csv"), "");
}

TEST(Csv, LinesThatLieAcrossBlocksOfAFileAreReadWhole) {
  const TemporaryFolder folder;
  std::string content = "\xef\xbb\xbfx,\"remark, long\"\r\n";
  // lines of every length, many blocks
  for (int k = 0; k < 3000; ++k) {
    content += std::to_string(k) + ".5,\"" + std::string(static_cast<std::size_t>(k % 97), ',') + "\"\"\"" +
               (k % 7 == 0 ? "\r\n\n" : "\n");
  }
  content += "1,last";
  write_file(folder / "log.csv", content);
  for (const CsvTable::Keep keep : {CsvTable::Keep::text, CsvTable::Keep::numbers}) {
    const CsvTable table = CsvTable::read(folder / "log.csv", keep);
    const CsvTable parsed = CsvTable::parse(content, "log.csv", keep);
    EXPECT_EQ(table.n_rows(), 3001);
    EXPECT_EQ(table.text(), parsed.text());
    for (int row = 0; row < table.n_rows(); ++row) ASSERT_EQ(table.line(row), parsed.line(row));
  }
}

// ---- long files, of which several read pieces

// Lines of three columns, most of them of numbers alone, over three megabytes; one of `lines` after each so many.
std::string long_log(const std::vector<std::string>& lines, int distance) {
  std::mt19937 random(5);
  std::uniform_real_distribution<double> number(-1e3, 1e3);
  std::string log = "\xef\xbb\xbfx, \"y\",z\r\n";
  for (int k = 0; log.size() < 3'300'000; ++k) {
    log += k % 5 == 0 ? fmt::format("{},,{}\n", number(random), k)
                      : fmt::format("{}, {} ,{:e}\r\n", number(random), k, number(random));
    if (!lines.empty() && k % distance == distance - 1)
      log += lines[static_cast<std::size_t>(k / distance) % lines.size()] + "\n";
  }
  return log;
}

// read(rank's workers) by each of some processes, for which threads stand
template <typename Read>
void read_by_ranks(int n_ranks, const Read& read) {
  test::ThreadRanks::Meeting meeting(n_ranks);
  std::vector<std::jthread> ranks;
  for (int rank = 0; rank < n_ranks; ++rank) {
    ranks.emplace_back([&, rank] { read(Workers(2, std::make_shared<test::ThreadRanks>(meeting, rank)), rank); });
  }
}

TEST(CsvPieces, WhoeverReadsThemTheTableIsTheSame) {
  const TemporaryFolder folder;
  const std::vector<std::string> odd = {
      "1,2,inf", "\"1\",\"a, b\"\"\",+3",           "", "   ", " ,\t, ", "1,2e999,3", "1,2,3 4", "nan,-0,1.",
      "1,\r2,3", std::string(10'000, ' ') + "1,2,3"};
  for (const int distance : {2, 997, 30'011, 1'000'000}) {
    const std::string log = long_log(odd, distance) + (distance == 2 ? "1,2,3" : "");
    const auto path = folder.write("log.csv", log);
    const CsvTable expected = CsvTable::parse(log, path.string(), CsvTable::Keep::numbers);
    const auto expect_table = [&](const Workers& workers, const std::string& by) {
      const CsvTable table = CsvTable::read(path, CsvTable::Keep::numbers, workers);
      ASSERT_EQ(table.n_rows(), expected.n_rows()) << by << ", one odd line of " << distance;
      EXPECT_EQ(table.text(), expected.text()) << by << ", one odd line of " << distance;
      for (int row = 0; row < table.n_rows(); ++row) ASSERT_EQ(table.line(row), expected.line(row)) << by << ", row " << row;
      EXPECT_EQ(table.file()->checksum, checksum(log)) << by;
      EXPECT_EQ(table.file()->bytes, log.size()) << by;
      EXPECT_EQ(table.file()->rows, expected.n_rows()) << by;
    };
    for (const int n_threads : {1, 3}) expect_table(n_threads, fmt::format("{} threads", n_threads));
    for (const int n_ranks : {2, 7}) {
      read_by_ranks(n_ranks, [&](const Workers& workers, int rank) {
        expect_table(workers, fmt::format("process {} of {}", rank, n_ranks));
      });
    }
  }
}

TEST(CsvPieces, LinesMayBeLongerThanThem) {
  const TemporaryFolder folder;
  std::string log = "x,y\n1,2\n";
  for (const int n : {1'100'000, 5, 3'000'000, 7}) log += "3," + std::string(static_cast<std::size_t>(n), '0') + "1\n";
  const auto path = folder.write("log.csv", log);
  const CsvTable table = CsvTable::read(path, CsvTable::Keep::numbers, 2);
  ASSERT_EQ(table.n_rows(), 5);
  for (int row = 1; row < 5; ++row) EXPECT_EQ(table.number(row, 1), 1);
  EXPECT_EQ(table.file()->checksum, checksum(log));
}

TEST(CsvPieces, TheHeaderMayStandBehindBlankLinesOfAWholePiece) {
  const TemporaryFolder folder;
  constexpr std::size_t n_blank = std::size_t{1} << 20;
  const auto path = folder.write("log.csv", std::string(n_blank, '\n') + "x,y\n1,2\n3,4\n");
  const CsvTable table = CsvTable::read(path, CsvTable::Keep::numbers, 2);
  ASSERT_EQ(table.n_rows(), 2);
  EXPECT_EQ(table.number(1, 1), 4);
  EXPECT_EQ(table.line(0), static_cast<int>(n_blank) + 2);
}

TEST(CsvPieces, AnErrorIsThatOfTheFirstLineThatHasOne) {
  const TemporaryFolder folder;
  std::string log = long_log({}, 1);
  const std::string error = "1,2\n";
  for (const std::size_t place : {log.size() / 2, log.size() - 100}) log.insert(log.find('\n', place) + 1, error);
  const auto path = folder.write("log.csv", log);
  const std::string expected = input_error_of([&] { CsvTable::parse(log, path.string(), CsvTable::Keep::numbers); });
  EXPECT_THAT(expected, HasSubstr("ragged row"));
  EXPECT_EQ(input_error_of([&] { CsvTable::read(path, CsvTable::Keep::numbers, 2); }), expected);
  read_by_ranks(3, [&](const Workers& workers, int) {
    EXPECT_EQ(input_error_of([&] { CsvTable::read(path, CsvTable::Keep::numbers, workers); }), expected);
  });
}

TEST(CsvPieces, ProcessesThatHaveDifferentFilesAreRefused) {
  const TemporaryFolder folder;
  std::string log = long_log({}, 1);
  const auto path = folder.write("log.csv", log);
  const std::size_t digit = log.find_first_of("123456789", log.size() - 1000);
  log[digit] = log[digit] == '1' ? '2' : '1';
  const auto one_digit = folder.write("one_digit.csv", log), longer = folder.write("longer.csv", log + "1,2,3\n"),
             short_one = folder.write("short.csv", "x,y,z\n1,2,3\n");
  for (const auto& other : {one_digit, longer, short_one}) {
    read_by_ranks(3, [&](const Workers& workers, int rank) {
      // the last of three reads the last pieces, where the digit is
      const std::string error =
          input_error_of([&] { CsvTable::read(rank == 2 ? other : path, CsvTable::Keep::numbers, workers); });
      EXPECT_THAT(error, HasSubstr("the processes of mpirun have read different data")) << other << " " << rank;
    });
  }
}

std::size_t n_files(const TemporaryFolder& folder) {
  return static_cast<std::size_t>(
      std::distance(std::filesystem::directory_iterator(folder.path()), std::filesystem::directory_iterator()));
}

TEST(WriteFile, LeavesNothingBehindWhenItFails) {
  const TemporaryFolder folder;
  std::filesystem::create_directory(folder / "taken");
  EXPECT_EQ(input_error_of([&] { write_file(folder / "taken", "x"); }),
            (folder / "taken").string() + ": cannot be written: Is a directory");
  EXPECT_EQ(input_error_of([&] { write_file(folder / "none/log.csv", "x"); }),
            (folder / "none/log.csv").string() + ": cannot be written: No such file or directory");
  EXPECT_THAT(input_error_of([&] { write_file(folder / std::string(255, 'x'), "x"); }),
              EndsWith(": cannot be written: File name too long"));
  EXPECT_EQ(n_files(folder), 1U);
}

TEST(WriteFile, LeavesTheOldFileIntactWhenTheFolderIsReadOnly) {
  if (geteuid() == 0) GTEST_SKIP() << "root may write anywhere";
  const TemporaryFolder folder;
  const auto path = folder.write("fit.json", "old");
  chmod(folder.path().c_str(), 0555);
  EXPECT_THAT(input_error_of([&] { write_file(path, "new"); }), EndsWith(": cannot be written: Permission denied"));
  chmod(folder.path().c_str(), 0755);
  EXPECT_EQ(read_file(path), "old");
  EXPECT_EQ(n_files(folder), 1U);
}

TEST(WriteFile, DoesNotReplaceAFileThatIsReadOnly) {
  const TemporaryFolder folder;
  const auto path = folder.write("fit.json", "old");
  chmod(path.c_str(), 0444);
  chmod(folder.path().c_str(), 0777);
  // root may write anywhere, so not as root
  const bool is_root = geteuid() == 0;
  if (is_root) {
    ASSERT_EQ(seteuid(65534), 0);
  }
  const std::string written = input_error_of([&] { write_file(path, "new"); });
  const std::string asked = input_error_of([&] { require_writable(path); });
  if (is_root) {
    ASSERT_EQ(seteuid(0), 0);
  }
  EXPECT_EQ(written, path.string() + ": cannot be written: Permission denied");
  EXPECT_EQ(asked, written);
  EXPECT_EQ(read_file(path), "old");
  EXPECT_EQ(n_files(folder), 1U);
}

TEST(WriteFile, CanBeAskedForBefore) {
  const TemporaryFolder folder;
  const auto old = folder.write("old", "old");
  const auto error_of = [](const std::filesystem::path& path) { return input_error_of([&] { require_writable(path); }); };
  EXPECT_EQ(error_of(folder / "new"), "");
  EXPECT_EQ(error_of(old), "");
  EXPECT_EQ(error_of("/dev/stdout"), "");
  EXPECT_EQ(error_of("new-file-in-the-working-folder"), "");
  EXPECT_EQ(error_of(folder.path()), folder.path().string() + ": cannot be written: Is a directory");
  EXPECT_EQ(error_of(folder / "none/new"), (folder / "none/new").string() + ": cannot be written: No such file or directory");
  EXPECT_EQ(error_of(old / "new"), (old / "new").string() + ": cannot be written: Not a directory");
  EXPECT_EQ(read_file(old), "old");
  EXPECT_EQ(n_files(folder), 1U);
}

TEST(WriteFile, LeavesTheOldFileIntactWhenTheDiskIsFull) {
  EXPECT_EQ(input_error_of([] { write_file("/dev/full", "x"); }), "/dev/full: cannot be written: No space left on device");
  // no disk can be filled here, but a limit on the size of files fails the same call of the system at the same place
  const TemporaryFolder folder;
  const auto path = folder.write("fit.json", "old");
  const pid_t child = fork();
  if (child == 0) {
    signal(SIGXFSZ, SIG_IGN);
    const rlimit limit = {5000, 5000};
    setrlimit(RLIMIT_FSIZE, &limit);
    const std::string error = input_error_of([&] { write_file(path, std::string(100000, 'x')); });
    const bool good = error == path.string() + ": cannot be written: File too large" && n_files(folder) == 1;
    _exit(good ? 0 : 1);
  }
  int status = 0;
  ASSERT_EQ(waitpid(child, &status, 0), child);
  EXPECT_EQ(status, 0);
  EXPECT_EQ(read_file(path), "old");
  EXPECT_EQ(n_files(folder), 1U);
}

TEST(WriteFile, LeavesTheOldFileIntactWhenWhatIsWrittenIsNotThere) {
  const TemporaryFolder folder;
  const auto path = folder.write("data.csv", "old");
  EXPECT_EQ(input_error_of([&] {
              write_blocks(path, [](const auto& put) {
                put("half of it");
                throw InputError("no more");
              });
            }),
            "no more");
  EXPECT_EQ(read_file(path), "old");
  EXPECT_EQ(n_files(folder), 1U);
}

TEST(WriteFile, WritesATableInBlocks) {
  std::vector<std::string> cells;
  for (int k = 0; k < 30000; ++k) cells.push_back(k % 3 == 0 ? "a, \"b\"" : std::to_string(k) + ".5");
  const CsvTable table = CsvTable::from_cells("data.csv", {"x"}, cells);
  const TemporaryFolder folder;
  table.write(folder / "data.csv");
  EXPECT_EQ(read_file(folder / "data.csv"), table.text());

  std::size_t n_blocks = 0, largest = 0;
  CsvWriter csv([&](std::string_view block) { ++n_blocks, largest = std::max(largest, block.size()); });
  for (const std::string& cell : cells) {
    csv.add(cell);
    csv.end_line();
  }
  csv.flush();
  EXPECT_GT(n_blocks, 3U);
  EXPECT_LT(largest, 70000U);
}

mode_t permissions(const std::filesystem::path& path) {
  struct stat status = {};
  EXPECT_EQ(stat(path.c_str(), &status), 0);
  return status.st_mode & 0777;
}

TEST(WriteFile, GivesANewFileThePermissionsOfTheProcessAndKeepsThoseOfAnOldOne) {
  const TemporaryFolder folder;
  const mode_t old_mask = umask(027);
  write_file(folder / "new", "x");
  umask(old_mask);
  EXPECT_EQ(permissions(folder / "new"), 0640U);
  chmod((folder / "new").c_str(), 0600);
  write_file(folder / "new", "y");
  EXPECT_EQ(permissions(folder / "new"), 0600U);
  EXPECT_EQ(read_file(folder / "new"), "y");
}

TEST(WriteFile, ReplacesWhatALinkPointsAt) {
  const TemporaryFolder folder;
  const auto target = folder.write("target", "old");
  std::filesystem::create_symlink(target, folder / "link");
  write_file(folder / "link", "new");
  EXPECT_TRUE(std::filesystem::is_symlink(folder / "link"));
  EXPECT_EQ(read_file(target), "new");
}

TEST(WriteFile, WritesToAPipeWithoutReplacingIt) {
  const TemporaryFolder folder;
  const std::string pipe = (folder / "pipe").string();
  ASSERT_EQ(mkfifo(pipe.c_str(), 0600), 0);
  std::string got;
  std::thread reader([&] { got = read_file(pipe); });
  write_file(pipe, "through the pipe");
  reader.join();
  EXPECT_EQ(got, "through the pipe");
  EXPECT_TRUE(std::filesystem::is_fifo(pipe));
  EXPECT_EQ(n_files(folder), 1U);
}

TEST(WriteFile, ManyThreadsLeaveOneWholeFile) {
  const TemporaryFolder folder;
  std::vector<std::thread> writers;
  for (int k = 0; k < 8; ++k) {
    writers.emplace_back([&folder, k] {
      for (int repeat = 0; repeat < 5; ++repeat) write_file(folder / "log.csv", std::string(5000, static_cast<char>('a' + k)));
    });
  }
  for (std::thread& writer : writers) writer.join();
  const std::string content = read_file(folder / "log.csv");
  EXPECT_EQ(content, std::string(5000, content.front()));
  EXPECT_EQ(n_files(folder), 1U);
}

// ---- a log that is read twice

TEST(Csv, RowsOfAFileComeAgainAsTheyArePrinted) {
  const TemporaryFolder folder;
  const std::filesystem::path path = folder / "log.csv";
  std::string text = "\xef\xbb\xbfq1, remark\r\n\n 1.50 ,\"a, b\"\r\n2,\"say \"\"no\"\"\"\n,\n3,\xef\xbb\xbfx\n \t\n";
  for (int k = 0; k < 20000; ++k) text += fmt::format("{},x{}\n", k, k);  // more than a block
  write_file(path, text + "4,end");
  const CsvTable table = CsvTable::read(path);
  int row = 0;
  for_each_row(path, [&](std::string_view cells) {
    std::string printed;
    CsvWriter csv([&](std::string_view block) { printed += block; });
    for (int column = 0; column < 2; ++column) csv.add(table.cell(row, column));
    csv.flush();
    EXPECT_EQ(cells, printed) << row;
    ++row;
  });
  EXPECT_EQ(row, table.n_rows());
  EXPECT_EQ(row, 20005);
}

TEST(Csv, AFileThatChangesWhileItIsReadIsRefused) {
  const TemporaryFolder folder;
  const std::filesystem::path path = folder / "log.csv";
  const auto write_rows = [&](int n) {
    std::string text = "q1\n";
    for (int k = 0; k < n; ++k) text += "0.123456789\n";
    write_file(path, text);
  };
  write_rows(20000);
  const std::optional<FileVersion> version = file_version(path);
  ASSERT_TRUE(version);
  EXPECT_EQ(file_version(path), version);
  int n_blocks = 0;
  EXPECT_EQ(input_error_of([&] {
              read_blocks(path, [&](std::string_view) {
                if (n_blocks++ == 0) std::ofstream(path, std::ios::app) << "1\n";
              });
            }),
            path.string() + ": changed while it was read; read it when nothing writes to it any more, or read a copy");
  EXPECT_GT(n_blocks, 1);
  EXPECT_NE(file_version(path), version);
  EXPECT_FALSE(file_version("/dev/null"));
  EXPECT_FALSE(file_version(folder / "absent.csv"));
}

}  // namespace
}  // namespace gp2
