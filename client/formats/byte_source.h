// Bytes of files and pipes, decompressed where they are compressed.
#ifndef REVISIT_CLIENT_FORMATS_BYTE_SOURCE_H_
#define REVISIT_CLIENT_FORMATS_BYTE_SOURCE_H_

#include <chrono>
#include <cstddef>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/statusor.h"

namespace revisit::client {

class ByteSource {
 public:
  virtual ~ByteSource() = default;

  // Reads what there is, at least one byte and at most `size`, waiting only
  // where there is nothing yet. 0 at the end.
  virtual absl::StatusOr<std::size_t> Read(char* buffer, std::size_t size) = 0;
};

// Called before each read that has to wait for a pipe. Returns after how long
// to be called again if nothing has come by then; nothing: not again.
using BeforeWait = std::function<std::optional<std::chrono::milliseconds>()>;

// Opens a file, or the standard input for "-". What begins as gzip or Zstandard
// does is decompressed; several compressed parts may follow each other.
// `before_wait` may be empty.
//
// NOT_FOUND or PERMISSION_DENIED if it cannot be opened, INVALID_ARGUMENT if it
// is no file. Read() returns DATA_LOSS if the device fails or compressed bytes
// are damaged or cut off.
absl::StatusOr<std::unique_ptr<ByteSource>> OpenBytes(
    const std::string& path, const BeforeWait& before_wait);

// Bytes that are in memory, decompressed likewise.
std::unique_ptr<ByteSource> BytesOf(std::string bytes);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_BYTE_SOURCE_H_
