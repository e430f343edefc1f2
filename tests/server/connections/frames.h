// HTTP/2 frames as a client sends them (RFC 9113, 4.1), for tests of what
// counts them.
#ifndef REVISIT_TESTS_SERVER_CONNECTIONS_FRAMES_H_
#define REVISIT_TESTS_SERVER_CONNECTIONS_FRAMES_H_

#include <cstddef>
#include <string>

#include "server/connections/connection_meter.h"
#include "server/connections/frame_reader.h"

namespace revisit::server {

inline constexpr char kPreface[] = "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

inline constexpr unsigned char kAnswer = 0x1;
inline constexpr unsigned char kEndHeaders = 0x4;

// A frame whose payload is all zeros.
inline std::string Frame(FrameType type, std::size_t length,
                         unsigned char flags = 0) {
  std::string frame;
  for (const int shift : {16, 8, 0}) {
    frame += static_cast<char>(length >> shift & 0xff);
  }
  frame += static_cast<char>(type);
  frame += static_cast<char>(flags);
  return frame + std::string(4 + length, '\0');
}

inline void CountFrames(const std::string& bytes, ConnectionMeter* meter) {
  meter->CountFrames(reinterpret_cast<const unsigned char*>(bytes.data()),
                     bytes.size());
}

// The preface, and so many calls whose headers have `bytes` each.
inline void BeginCalls(std::size_t calls, std::size_t bytes,
                       ConnectionMeter* meter) {
  std::string frames = kPreface;
  for (std::size_t i = 0; i < calls; ++i) {
    frames += Frame(FrameType::kHeaders, bytes, kEndHeaders);
  }
  CountFrames(frames, meter);
}

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_CONNECTIONS_FRAMES_H_
