#include <cmath>

#include "fuzz/fuzz.hpp"
#include "gp2/data/csv.hpp"

using gp2::CsvTable;
using gp2::test::accepts;
using gp2::test::require;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  CsvTable table;
  if (!accepts([&] { table = CsvTable::parse(gp2::test::text_of(data, size), "log.csv"); })) return 0;

  require(table.n_rows() > 0 && table.n_columns() > 0, "a table has rows and columns");
  for (int column = 0; column < table.n_columns(); ++column) {
    require(table.find(table.header()[static_cast<std::size_t>(column)]) == column, "a column is found by its name");
    for (int row = 0; row < table.n_rows(); ++row) {
      accepts([&] { require(std::isfinite(table.number(row, column)), "a number is finite"); });
      accepts([&] { require(!std::isinf(table.number_or_nan(row, column)), "a number is finite or missing"); });
    }
  }

  // what is written reads back, cell by cell
  const std::string text = table.text();
  const CsvTable again = CsvTable::parse(text, "log.csv");
  require(again.header() == table.header() && again.n_rows() == table.n_rows(), "a table reads back");
  for (int row = 0; row < table.n_rows(); ++row) {
    for (int column = 0; column < table.n_columns(); ++column) {
      require(again.cell(row, column) == table.cell(row, column), "a cell reads back");
    }
  }
  return 0;
}
