// Reads texts for tests.
#ifndef REVISIT_TESTS_CLIENT_FORMATS_READING_H_
#define REVISIT_TESTS_CLIENT_FORMATS_READING_H_

#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "client/formats/reader.h"

namespace revisit::client {

// All samples of a text, as of a file "a.txt".
inline absl::StatusOr<std::vector<Sample>> ReadText(
    std::string text, const ReaderOptions& options) {
  auto reader = ReadSamples(BytesOf(std::move(text)), "a.txt", options);
  if (!reader.ok()) return reader.status();
  std::vector<Sample> samples;
  for (;;) {
    auto sample = (*reader)->Next();
    if (!sample.ok()) return sample.status();
    if (!sample->has_value()) return samples;
    samples.push_back(**std::move(sample));
  }
}

// What a test makes up need not look like a vehicle.
inline absl::StatusOr<std::vector<Sample>> ReadText(std::string text) {
  ReaderOptions options;
  options.accept_suspicious = true;
  return ReadText(std::move(text), options);
}

inline std::string MessageOf(const absl::StatusOr<std::vector<Sample>>& read) {
  return std::string(read.status().message());
}

}  // namespace revisit::client

#endif  // REVISIT_TESTS_CLIENT_FORMATS_READING_H_
