// The results of an evaluation, as tables and as JSON.
#ifndef REVISIT_CLIENT_EVALUATION_EVALUATION_REPORT_H_
#define REVISIT_CLIENT_EVALUATION_EVALUATION_REPORT_H_

#include <cstddef>
#include <cstdint>
#include <optional>
#include <ostream>
#include <string>
#include <vector>

#include "client/evaluation/evaluation.h"
#include "client/formats/drive_file.h"

namespace revisit::client {

// One method on one drive.
struct DriveResult {
  std::string drive;
  // The seed of a simulated drive.
  std::optional<std::uint64_t> seed;
  std::vector<GraphNode> nodes;
  // One for each node.
  std::vector<PlanarPose> truth_at_nodes;
  // All answers, and those of them that count.
  std::vector<CheckAnswer> answers;
  std::vector<JudgedCheck> checks;
  Tally tally;
  // How far the asking recording went until a verifier tied it to another one;
  // absent where none did.
  std::optional<double> linked_after_meters;
  // Vehicle.consistency at the end, where a verifier took part.
  std::optional<double> inflation;
};

struct MethodResult {
  std::string method;
  double sequence_length_meters = 0.0;
  std::vector<DriveResult> drives;
  // Where claims are swept: the factor of the claimed standard deviations.
  std::optional<double> claimed_scale = std::nullopt;
};

// The method's name, with its sequence length if the methods differ in theirs,
// and its claimed scale if it has one.
std::string NameAmong(const std::vector<MethodResult>& methods,
                      const MethodResult& method);

Tally TotalOf(const MethodResult& method);

// The figure with this many digits after the point; a dash where there is none.
std::string FigureText(std::optional<double> value, int digits);

struct Report {
  // At least one, with the same drives in each.
  std::vector<MethodResult> methods;
  // The method that was asked for; the others are there to compare.
  std::size_t main = 0;
  // Whether a verifier took part.
  bool verified = false;
  // Whether drives are recordings of one vehicle, of which one asks.
  bool recordings = false;
  int repeats = 1;
  // Printed below the tables.
  std::vector<std::string> notes;
};

// Prints a line for each check: its first candidate. Both print tables of at
// most `width` columns of the terminal, or as Table does (table.h).
void PrintChecks(const DriveResult& result, std::ostream& out,
                 std::size_t width = 0);

// Prints a single row as a list and several as a table: for each method its
// drives, all seeds of a drive in one row, and the total; for each claimed
// scale the total alone.
void PrintReport(const Report& report, std::ostream& out,
                 std::size_t width = 0);

// {"drives", "total", "methods", "repeats", "notes"}; see run_evaluation.h.
std::string ReportJson(const Report& report, bool verbose);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_EVALUATION_REPORT_H_
