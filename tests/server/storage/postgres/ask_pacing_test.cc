#include "server/storage/postgres/ask_pacing.h"

#include <chrono>

#include "gtest/gtest.h"

namespace revisit::server {
namespace {

using std::chrono::seconds;

constexpr int kFewest = static_cast<int>(AskPacing::kFewest);

class AskPacingTest : public ::testing::Test {
 protected:
  // Asks for further vehicles until told not to; returns how many.
  int AskForAll(seconds now) {
    int asked = 0;
    while (pacing_.MayAsk(next_, now)) {
      ++next_;
      ++asked;
    }
    return asked;
  }

  AskPacing pacing_{seconds(4), seconds(14)};
  VehicleKey next_ = 1;
};

TEST_F(AskPacingTest, AFewAreAskedForTogetherAndNoMoreUntilOneComes) {
  EXPECT_EQ(AskForAll(seconds(100)), kFewest);
  EXPECT_TRUE(pacing_.MayAsk(1, seconds(100)));
  pacing_.Taken(1, seconds(101));
  EXPECT_EQ(AskForAll(seconds(101)), 1);
}

TEST_F(AskPacingTest, AsManyAreAskedForAsWereTakenInAWindow) {
  for (VehicleKey key = -1; key >= -300; --key) {
    pacing_.Taken(key, seconds(100));
  }
  EXPECT_EQ(AskForAll(seconds(101)), 300);
  EXPECT_EQ(AskForAll(seconds(105)), 0);
}

TEST_F(AskPacingTest, AServerThatTakesNoneAsksForAFewAgain) {
  for (VehicleKey key = -1; key >= -300; --key) {
    pacing_.Taken(key, seconds(100));
  }
  EXPECT_EQ(AskForAll(seconds(200)), kFewest);
}

TEST_F(AskPacingTest, OnesThatDoNotComeMakeRoomInTheEnd) {
  EXPECT_EQ(AskForAll(seconds(100)), kFewest);
  EXPECT_EQ(AskForAll(seconds(113)), 0);
  EXPECT_EQ(AskForAll(seconds(118)), kFewest);
}

}  // namespace
}  // namespace revisit::server
