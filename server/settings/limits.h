// Every bound the server sets to what callers may ask of it, in one place. A
// limit that may be off is off at 0, as its flag says.
#ifndef REVISIT_SERVER_SETTINGS_LIMITS_H_
#define REVISIT_SERVER_SETTINGS_LIMITS_H_

#include <cstdint>

namespace revisit::server {

struct Limits {
  // ---- Connections (connection_acceptor.h)

  // On all listening addresses; 0 leaves only the bound of descriptors: three
  // quarters of what the process may open, the rest is for files. Range [0,
  // 1e6].
  int max_connections = 0;
  // From one address; 0 means as many as from all. Range [0, 1e6].
  int max_connections_per_address = 0;
  // A connection that has not said by then what a gRPC client says first is
  // closed. Range [0.1, 3600].
  double handshake_timeout_seconds = 10.0;
  // A connection without calls is closed after this long. Range [1, 1e6].
  double connection_idle_seconds = 60.0;
  // A connection that is silent this long is pinged, and closed if no answer
  // comes. Range [1, 86400] and [1, 3600].
  double keepalive_seconds = 60.0;
  double keepalive_timeout_seconds = 20.0;
  // Calls at a time on one connection, and half of what it may have in memory:
  // one that begins calls and resets them, faster than they can be cleared
  // away, is closed. Range [1, 1e6].
  int max_concurrent_streams = 1000;
  // Of the headers of one call. A call beyond it takes its connection with it:
  // a proxy in front must allow less. Range [8192, 2^24].
  int max_metadata_bytes = 32 << 10;
  // A connection that has brought so much more than its calls and messages were
  // credited is closed: each for as much as one may bring, once its caller is
  // let in, and all when none is open. It has to be more than what calls at a
  // time may have begun to send; off at 0. Range [0, 2^40].
  std::int64_t max_idle_bytes = 64 << 20;
  // The same of a connection that has not had a call let in; all of them
  // together may have brought four times as much. Off at 0. Range [0, 2^40].
  std::int64_t max_unadmitted_bytes = 16 << 20;
  // Connections that have not had a call let in: of more, the oldest are
  // closed. Off at 0. Range [0, 1e6].
  int max_unadmitted_connections = 2000;
  // What all connections together may buffer. Range [2^24, 2^40].
  std::int64_t max_transport_bytes = std::int64_t{512} << 20;

  // ---- Messages

  // Largest message read. Range [1024, 2^30].
  std::int64_t max_message_bytes = 4 << 20;
  // Most poses in a batch. Range [1, 1e6].
  int max_batch_poses = 4096;
  // Most bytes that one RevisePoses call may bring. They wait on the disk
  // (revision_draft.h). Range [1024, 2^36].
  std::int64_t max_revision_bytes = std::int64_t{256} << 20;
  // What all such calls together may bring, in steps of a mebibyte, which a
  // single one may exceed; those of one vehicle may come to max_revision_bytes.
  // Range [1024, 2^40].
  std::int64_t max_draft_bytes = std::int64_t{1} << 30;

  // ---- Streams (admission.h for those over all calls)

  // StreamPoses, RevisePoses and ExportPoseGraph calls at a time: in all, of
  // one vehicle, and of one caller; the last is off at 0. Range [1, 1e6], and
  // [0, 1e6] for a caller.
  int max_streams = 10000;
  int max_streams_per_vehicle = 32;
  int max_streams_per_caller = 0;
  // Batches of one stream that may wait for their acknowledgement to be sent,
  // and the memory that they may take, which a single one may exceed. Range [1,
  // 10000] and [1024, 2^30].
  int max_batches_in_flight = 512;
  std::int64_t max_bytes_in_flight = std::int64_t{2} << 20;
  // Candidates of one stream that may wait for the client to read them, and
  // how long a client that let more come has to read why its stream ends. A
  // client that takes nothing of an export for that long is told the same, and
  // has as long again. Range [4096, 2^36] and [0.1, 3600].
  std::int64_t max_unread_bytes = 8 << 20;
  double slow_consumer_seconds = 10.0;
  // Memory of the graphs that are being exported, each revision once; those of
  // one vehicle may come to a quarter of it. One alone may take more. Range
  // [1024, 2^40].
  std::int64_t max_export_bytes = std::int64_t{256} << 20;

  // ---- Queues

  // Batches of one vehicle, over all its streams and calls, that may wait.
  // Range [1, 1e6].
  int max_pending_appends = 1024;
  // Bytes of the batches that were read and are not durable, and of the message
  // of each revision that is being taken on: of one vehicle, and in all. Range
  // [1024, 2^40].
  std::int64_t max_queued_bytes_per_vehicle = std::int64_t{64} << 20;
  std::int64_t max_queued_bytes = std::int64_t{256} << 20;

  // ---- Other calls

  // Unary calls that wait or run. Range [1, 1e6].
  int max_calls = 1000;
  // Searches among them (FindCandidates): in all, and of one vehicle. Range [1,
  // 1e6].
  int max_searches = 64;
  int max_searches_per_vehicle = 16;
  // Searches a second of one caller; off at 0. Range [0, 1e6].
  double max_search_rate_per_caller = 0.0;
  // Of one search, nodes of the sequence times nodes of the history. Range
  // [1000, 1e12].
  std::int64_t max_search_steps = 300'000'000;

  // ---- Memory

  // Resident memory of the process from which on new work is refused and idle
  // vehicles are unloaded; 0 means three quarters of what the machine or the
  // control group has. Range [0, 2^50].
  std::int64_t max_memory_bytes = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SETTINGS_LIMITS_H_
