// The answers of a stream of poses that wait to be written, in their order.
#ifndef REVISIT_SERVER_SERVICE_ANSWER_QUEUE_H_
#define REVISIT_SERVER_SERVICE_ANSWER_QUEUE_H_

#include <cstddef>
#include <cstdint>
#include <deque>
#include <memory>

#include "revisit/v1/pose_graph_service.pb.h"
#include "server/conversion/pose_inspection.h"
#include "server/sessions/append_request.h"

namespace revisit::server {

class AnswerQueue {
 public:
  // REQUIRES: the response is not null.
  void Add(std::unique_ptr<v1::StreamPosesResponse> response);
  // An acknowledgement with warnings beside its own.
  void Add(const Acknowledgement& acknowledgement,
           const PoseInspector::Warnings& warnings);
  // Candidates, which take so many bytes. They are counted until they are
  // taken.
  void AddCandidates(std::unique_ptr<v1::StreamPosesResponse> response,
                     std::int64_t bytes);

  bool empty() const { return answers_.empty(); }
  std::size_t size() const { return answers_.size(); }
  // Bytes of the candidates that wait.
  std::int64_t candidate_bytes() const { return candidate_bytes_; }

  // Takes the first answer. An acknowledgement, of which there are many, reuses
  // the memory of the response before. REQUIRES: not empty.
  void Take(v1::StreamPosesResponse* response);

  void DropCandidates();
  void Clear();

 private:
  // `other`, or an acknowledgement without warnings if that is null.
  struct Answer {
    Acknowledgement acknowledgement;
    std::unique_ptr<v1::StreamPosesResponse> other;
    // Zero unless it holds candidates.
    std::int64_t candidate_bytes = 0;
  };

  std::deque<Answer> answers_;
  std::int64_t candidate_bytes_ = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_ANSWER_QUEUE_H_
