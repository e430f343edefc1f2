#include "client/terminal/output_file.h"

#include <fstream>
#include <ostream>
#include <sstream>
#include <string>

#include "absl/status/status.h"
#include "client/terminal/terminal.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::EndsWith;

// Writes so many lines, and looks at the end whether they could be written.
absl::Status WriteLines(std::ostream& out, int count) {
  for (int i = 0; i < count; ++i) out << "a line\n";
  return CheckOutput(out);
}

class FullDiskTest : public ::testing::TestWithParam<int> {};

// A few lines are written when the file is closed, many before.
INSTANTIATE_TEST_SUITE_P(OutputTest, FullDiskTest,
                         ::testing::Values(1, 1000, 100'000));

TEST_P(FullDiskTest, IsToldWithTheNameOfTheFile) {
  std::ostringstream terminal;
  const absl::Status status =
      WriteTo("/dev/full", terminal,
              [](std::ostream& out) { return WriteLines(out, GetParam()); });
  EXPECT_EQ(status.code(), absl::StatusCode::kResourceExhausted);
  EXPECT_EQ(status.message(), "/dev/full: No space left on device");
  EXPECT_EQ(ExitCodeOf(status), kExitLocalError);
}

TEST_P(FullDiskTest, IsToldOfTheTerminal) {
  std::ofstream terminal("/dev/full");
  const absl::Status status = WriteTo("", terminal, [](std::ostream& out) {
    return WriteLines(out, GetParam());
  });
  EXPECT_EQ(status.code(), absl::StatusCode::kResourceExhausted);
  EXPECT_EQ(status.message(),
            "the output cannot be written: No space left on device");
  EXPECT_EQ(ExitCodeOf(status), kExitLocalError);
}

TEST(OutputFileTest, FullDiskIsToldOfALongTextToo) {
  std::ofstream terminal("/dev/full");
  const absl::Status status = WriteTo("", terminal, [](std::ostream& out) {
    out << std::string(1'000'000, 'a');
    return CheckOutput(out);
  });
  EXPECT_EQ(status.code(), absl::StatusCode::kResourceExhausted);
}

TEST(OutputFileTest, FolderThatIsNotThereIsTold) {
  std::ostringstream terminal;
  const absl::Status status =
      WriteTo("/no/such/folder/file", terminal,
              [](std::ostream& out) { return WriteLines(out, 1); });
  EXPECT_EQ(status.code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(std::string(status.message()),
              EndsWith("/no/such/folder/file: No such file or directory"));
}

TEST(OutputFileTest, ErrorOfWhoWritesIsNoneOfTheFile) {
  std::ostringstream terminal;
  const absl::Status status = WriteTo("/dev/null", terminal, [](std::ostream&) {
    return absl::DataLossError("lost");
  });
  EXPECT_EQ(status, absl::DataLossError("lost"));
}

}  // namespace
}  // namespace revisit::client
