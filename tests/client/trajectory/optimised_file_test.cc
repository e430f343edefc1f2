#include "client/trajectory/optimised_file.h"

#include <cstdio>
#include <fstream>

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

class OptimisedFile : public ::testing::Test {
 protected:
  OptimisedFile()
      : path_(::testing::TempDir() + "optimised_" +
              ::testing::UnitTest::GetInstance()->current_test_info()->name()) {
  }
  ~OptimisedFile() override { std::remove(path_.c_str()); }

  absl::StatusOr<std::vector<OptimisedPose>> Read(const std::string& text,
                                                  OptimisedFormat format) {
    std::ofstream(path_) << text;
    return ReadOptimisedFile(path_, format);
  }

  std::string ErrorOf(const std::string& text, OptimisedFormat format) {
    const auto read = Read(text, format);
    EXPECT_EQ(read.status().code(), absl::StatusCode::kInvalidArgument);
    const std::string message(read.status().message());
    EXPECT_EQ(message.substr(0, path_.size() + 1), path_ + ":");
    return message.substr(path_.size() + 1);
  }

  const std::string path_;
};

TEST_F(OptimisedFile, TumLinesAreFoundByStamp) {
  const auto read = Read(
      "# evo writes doubles\n"
      "1.606417097528000116e+09 1 2 3 0 0 0.6 0.8\n",
      OptimisedFormat::kTum);
  ASSERT_TRUE(read.ok()) << read.status();
  ASSERT_EQ(read->size(), 1u);
  const OptimisedPose& pose = read->front();
  EXPECT_EQ(pose.line, 2);
  EXPECT_FALSE(pose.sequence);
  EXPECT_NEAR(
      static_cast<double>(*pose.stamp_nanoseconds - 1'606'417'097'528'000'000),
      0.0, 200.0);
  EXPECT_EQ(pose.z, 3.0);
  EXPECT_THAT(*pose.quaternion, ElementsAre(0.0, 0.0, 0.6, 0.8));
  EXPECT_FALSE(pose.covariance);
}

TEST_F(OptimisedFile, G2oVerticesAreFoundBySequenceAndEdgesPassedOver) {
  const auto read = Read(
      "VERTEX_SE2 7 1 2 0.5\n"
      "EDGE_SE2 7 8 1 0 0 1 0 0 1 0 1\n"
      "FIX 7\n"
      "\n"
      "VERTEX_SE3:QUAT 8 1 2 3 0 0 0 1\n",
      OptimisedFormat::kG2o);
  ASSERT_TRUE(read.ok()) << read.status();
  ASSERT_EQ(read->size(), 2u);
  EXPECT_EQ((*read)[0].sequence, 7u);
  EXPECT_EQ((*read)[0].heading, 0.5);
  EXPECT_FALSE((*read)[0].z);
  EXPECT_EQ((*read)[1].sequence, 8u);
  EXPECT_EQ((*read)[1].line, 5);
  EXPECT_TRUE((*read)[1].quaternion);
}

TEST_F(OptimisedFile, CsvHasWhatItsColumnsName) {
  const auto read = Read(
      "note,est_yaw,est_y,est_x,sequence,pxx,pxy,pxt,pyy,pyt,ptt,est_z\n"
      "a,0.5,2,1,3,1,0,0,2,0,3,\n"
      "b,0.5,2,1,4,,,,,,,9\n",
      OptimisedFormat::kCsv);
  ASSERT_TRUE(read.ok()) << read.status();
  ASSERT_EQ(read->size(), 2u);
  EXPECT_EQ((*read)[0].x, 1.0);
  EXPECT_EQ((*read)[0].heading, 0.5);
  EXPECT_FALSE((*read)[0].z);
  EXPECT_THAT((*read)[0].covariance->values(), ElementsAre(1, 0, 0, 2, 0, 3));
  EXPECT_EQ((*read)[1].z, 9.0);
  EXPECT_FALSE((*read)[1].covariance);
}

TEST_F(OptimisedFile, MistakesAreNamedWithTheirLine) {
  EXPECT_EQ(ErrorOf("1 2 3\n", OptimisedFormat::kTum),
            "1: expected the 8 fields t x y z qx qy qz qw, got 3");
  EXPECT_THAT(ErrorOf("\n1 2 3 4 0 0 0 2\n", OptimisedFormat::kTum),
              HasSubstr("2: the norm of the quaternion is 2, expected 1"));
  EXPECT_THAT(ErrorOf("1 2 x 4 0 0 0 1\n", OptimisedFormat::kTum),
              HasSubstr("expected a finite number for field 3, got \"x\""));
  EXPECT_THAT(ErrorOf("1e12 2 3 4 0 0 0 1\n", OptimisedFormat::kTum),
              HasSubstr("expected seconds since 1970"));
  EXPECT_THAT(ErrorOf("VERTEX_SE2 0 1 2 3\n", OptimisedFormat::kG2o),
              HasSubstr("expected the sequence of a pose, from 1, got \"0\""));
  EXPECT_THAT(ErrorOf("1 2 3 4 5 6 7 8\n", OptimisedFormat::kG2o),
              HasSubstr("expected VERTEX_SE2, VERTEX_SE3:QUAT"));
  EXPECT_THAT(ErrorOf("sequence,est_x,est_y\n", OptimisedFormat::kCsv),
              HasSubstr("1: there is no column est_yaw"));
  EXPECT_THAT(
      ErrorOf("sequence,est_x,est_y,est_yaw,qx\n", OptimisedFormat::kCsv),
      HasSubstr("there is no column qy"));
  EXPECT_THAT(
      ErrorOf("sequence,est_x,est_y,est_yaw\n1,2,3\n", OptimisedFormat::kCsv),
      HasSubstr("2: expected 4 fields, got 3"));
  EXPECT_THAT(ErrorOf("# nothing\n", OptimisedFormat::kG2o),
              HasSubstr("the file holds no poses"));
}

TEST_F(OptimisedFile, FileThatIsNotThereIsNotFound) {
  EXPECT_EQ(
      ReadOptimisedFile("/nowhere", OptimisedFormat::kTum).status().code(),
      absl::StatusCode::kNotFound);
}

}  // namespace
}  // namespace revisit::client
