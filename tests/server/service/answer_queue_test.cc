#include "server/service/answer_queue.h"

#include <cstdint>
#include <memory>
#include <utility>

#include "gtest/gtest.h"

namespace revisit::server {
namespace {

using Response = v1::StreamPosesResponse;

Acknowledgement AckOf(std::uint64_t sequence) {
  Acknowledgement acknowledgement;
  acknowledgement.durable_sequence = sequence;
  return acknowledgement;
}

std::unique_ptr<Response> Candidates() {
  auto response = std::make_unique<Response>();
  response->mutable_candidates();
  return response;
}

TEST(AnswerQueueTest, AnswersComeInTheirOrder) {
  AnswerQueue queue;
  auto opened = std::make_unique<Response>();
  opened->mutable_opened()->set_revision(7);
  queue.Add(std::move(opened));
  queue.Add(AckOf(1), {});
  queue.AddCandidates(Candidates(), 100);
  queue.Add(AckOf(2), {});
  ASSERT_EQ(queue.size(), 4u);
  // One response is used for all.
  Response response;
  queue.Take(&response);
  EXPECT_EQ(response.opened().revision(), 7u);
  queue.Take(&response);
  EXPECT_EQ(response.ack().durable_sequence(), 1u);
  queue.Take(&response);
  EXPECT_TRUE(response.has_candidates());
  queue.Take(&response);
  EXPECT_EQ(response.ack().durable_sequence(), 2u);
  EXPECT_TRUE(queue.empty());
}

TEST(AnswerQueueTest, CandidatesCountUntilTheyAreTaken) {
  AnswerQueue queue;
  queue.AddCandidates(Candidates(), 100);
  queue.AddCandidates(Candidates(), 20);
  EXPECT_EQ(queue.candidate_bytes(), 120);
  Response response;
  queue.Take(&response);
  EXPECT_EQ(queue.candidate_bytes(), 20);
}

TEST(AnswerQueueTest, CandidatesThatAreDroppedLeaveTheAcknowledgements) {
  AnswerQueue queue;
  queue.Add(AckOf(1), {});
  queue.AddCandidates(Candidates(), 100);
  queue.Add(AckOf(2), {});
  queue.DropCandidates();
  EXPECT_EQ(queue.candidate_bytes(), 0);
  ASSERT_EQ(queue.size(), 2u);
  Response response;
  queue.Take(&response);
  EXPECT_EQ(response.ack().durable_sequence(), 1u);
  queue.Take(&response);
  EXPECT_EQ(response.ack().durable_sequence(), 2u);
}

TEST(AnswerQueueTest, WarningsComeWithTheirAcknowledgementOnly) {
  AnswerQueue queue;
  PoseInspector::Warnings warnings;
  warnings.Add()->set_message("steep");
  queue.Add(AckOf(1), warnings);
  queue.Add(AckOf(2), {});
  Response response;
  queue.Take(&response);
  ASSERT_EQ(response.ack().warnings_size(), 1);
  EXPECT_EQ(response.ack().warnings(0).message(), "steep");
  queue.Take(&response);
  EXPECT_EQ(response.ack().durable_sequence(), 2u);
  EXPECT_EQ(response.ack().warnings_size(), 0);
}

}  // namespace
}  // namespace revisit::server
