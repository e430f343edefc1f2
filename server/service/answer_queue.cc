#include "server/service/answer_queue.h"

#include <utility>

#include "server/conversion/answers.h"

namespace revisit::server {

void AnswerQueue::Add(std::unique_ptr<v1::StreamPosesResponse> response) {
  answers_.push_back({{}, std::move(response)});
}

void AnswerQueue::Add(const Acknowledgement& acknowledgement,
                      const PoseInspector::Warnings& warnings) {
  if (warnings.empty() && !acknowledgement.has_warnings()) {
    answers_.push_back({acknowledgement, nullptr});
    return;
  }
  auto response = std::make_unique<v1::StreamPosesResponse>();
  EncodeAck(acknowledgement, response->mutable_ack());
  response->mutable_ack()->mutable_warnings()->MergeFrom(warnings);
  Add(std::move(response));
}

void AnswerQueue::AddCandidates(
    std::unique_ptr<v1::StreamPosesResponse> response, std::int64_t bytes) {
  candidate_bytes_ += bytes;
  answers_.push_back({{}, std::move(response), bytes});
}

void AnswerQueue::Take(v1::StreamPosesResponse* response) {
  Answer answer = std::move(answers_.front());
  answers_.pop_front();
  candidate_bytes_ -= answer.candidate_bytes;
  if (answer.other != nullptr) {
    *response = *std::move(answer.other);
  } else {
    EncodeAck(answer.acknowledgement, response->mutable_ack());
  }
}

void AnswerQueue::DropCandidates() {
  std::deque<Answer> kept;
  for (Answer& answer : answers_) {
    if (answer.candidate_bytes == 0) kept.push_back(std::move(answer));
  }
  answers_.swap(kept);
  candidate_bytes_ = 0;
}

void AnswerQueue::Clear() {
  answers_.clear();
  candidate_bytes_ = 0;
}

}  // namespace revisit::server
