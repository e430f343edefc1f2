// The bounds to its callers that the server's options set. Limits that can be
// off are off at 0, as their flags say.
//
// Bounds that no option sets stand with the code that keeps them: what follows
// from an option (kCallsToClear, kUnadmittedMemory in server.cc, kShares in
// connection_meter.cc), and the pairs of poses that a vehicle may have
// (VehicleSession::Limits).
#ifndef REVISIT_SERVER_SETTINGS_LIMITS_H_
#define REVISIT_SERVER_SETTINGS_LIMITS_H_

#include <cstdint>

namespace revisit::server {

struct Limits {
  // ---- Connections (connection_acceptor.h)

  // Connections on all listening addresses; 0 leaves only the bound of
  // descriptors: three quarters of those that the process may open, since the
  // rest is for files. Range [0, 1e6].
  int max_connections = 0;
  // Connections from one address; 0 means as many as from all. Range [0, 1e6].
  int max_connections_per_address = 0;
  // A connection is closed if it has not opened as a gRPC client does by then.
  // Range [0.1, 3600].
  double handshake_timeout_seconds = 10.0;
  // A connection without calls is closed after this long. Range [1, 1e6].
  double connection_idle_seconds = 60.0;
  // A connection that is silent this long is pinged, and closed if no answer
  // comes. Range [1, 86400] and [1, 3600].
  double keepalive_seconds = 60.0;
  double keepalive_timeout_seconds = 20.0;
  // Calls at a time on one connection. Another 1,000 may have been reset and
  // not yet been cleared away: a connection that holds more in memory, because
  // it begins and resets calls faster than that, is closed. Range [1, 1e6].
  int max_concurrent_streams = 1000;
  // Bytes of the headers of one call. A call with more ends its connection, so
  // that a proxy in front must allow less. Range [8192, 2^24].
  int max_metadata_bytes = 32 << 10;
  // Bytes that a connection may bring beyond its credit before it is closed.
  // Each call whose caller is admitted, and each message, is credited with the
  // most that one may bring; when no call is open, all bytes are credited. The
  // limit has to exceed the bytes that the calls at a time may have begun to
  // send; off at 0. Range [0, 2^40].
  std::int64_t max_idle_bytes = 64 << 20;
  // max_idle_bytes of a connection none of whose calls was admitted; all such
  // connections together may have brought four times as much. Off at 0. Range
  // [0, 2^40].
  std::int64_t max_unadmitted_bytes = 16 << 20;
  // Connections none of whose calls was admitted: if there are more, the oldest
  // are closed. Off at 0. Range [0, 1e6].
  int max_unadmitted_connections = 2000;
  // Bytes that all connections together may buffer. Range [2^24, 2^40].
  std::int64_t max_transport_bytes = std::int64_t{512} << 20;

  // ---- Messages

  // Largest message that is read. Range [1024, 2^30].
  std::int64_t max_message_bytes = 4 << 20;
  // Most poses in a batch. Range [1, 1e6].
  int max_batch_poses = 4096;
  // Most bytes that one RevisePoses call may bring. They wait on the disk
  // (revision_draft.h). Range [1024, 2^36].
  std::int64_t max_revision_bytes = std::int64_t{256} << 20;
  // Bytes that all such calls together may bring, counted in steps of a
  // mebibyte; a single call may exceed it. Those about one vehicle may bring
  // max_revision_bytes. Range [1024, 2^40].
  std::int64_t max_draft_bytes = std::int64_t{1} << 30;

  // ---- Streams (admission.h for those over all calls)

  // StreamPoses, RevisePoses and ExportPoseGraph calls at a time: in all, per
  // vehicle, and per caller; the last is off at 0. Range [1, 1e6], and [0, 1e6]
  // per caller.
  int max_streams = 10000;
  int max_streams_per_vehicle = 32;
  int max_streams_per_caller = 0;
  // StreamPoses calls that are older end (STREAM_AGE) once what they brought is
  // acknowledged; their clients open others, for which a balancer chooses a
  // server again. Each ends up to a tenth sooner, so that those that began
  // together do not end together. The other streaming calls come to an end by
  // themselves, and could not go on where they were cut. Off at 0. Range [0,
  // 1e6].
  double max_stream_age_seconds = 0.0;
  // Batches of one stream that may wait for their acknowledgement to be sent,
  // and the memory that they may take, which a single one may exceed. Range [1,
  // 10000] and [1024, 2^30].
  int max_batches_in_flight = 512;
  std::int64_t max_bytes_in_flight = std::int64_t{2} << 20;
  // Bytes of candidates of one stream that may wait for the client to read
  // them, and how long a client that exceeds this has to read why its stream
  // ends. An export that the client has not read from for that long ends
  // likewise, with as long again to read why. Range [4096, 2^36] and [0.1,
  // 3600].
  std::int64_t max_unread_bytes = 8 << 20;
  double slow_consumer_seconds = 10.0;
  // Memory of the graphs that are being exported, each revision counted once;
  // those of one vehicle may take a quarter of it. One alone may take more.
  // Range [1024, 2^40].
  std::int64_t max_export_bytes = std::int64_t{256} << 20;

  // ---- Queues

  // Batches of one vehicle, over all its streams and calls, that may wait.
  // Range [1, 1e6].
  int max_pending_appends = 1024;
  // Bytes of the batches that were read and are not durable, and of the message
  // of each revision that is being processed: per vehicle, and in all. Range
  // [1024, 2^40].
  std::int64_t max_queued_bytes_per_vehicle = std::int64_t{64} << 20;
  std::int64_t max_queued_bytes = std::int64_t{256} << 20;

  // ---- Other calls

  // Unary calls that wait or run: in all, per vehicle, and per caller; the last
  // is off at 0. Range [1, 1e6], and [0, 1e6] per caller.
  int max_calls = 2000;
  int max_calls_per_vehicle = 128;
  int max_calls_per_caller = 1000;
  // Poses of the vehicles whose graphs are made anew at a time by calls that
  // revise poses or change settings that move nodes: in all, and per caller,
  // off at 0. A vehicle counts for no more than either. Range [1000, 1e12], and
  // [0, 1e12] per caller.
  std::int64_t max_rebuilt_poses = 16'000'000;
  std::int64_t max_rebuilt_poses_per_caller = 4'000'000;
  // Searches among them (FindCandidates): in all, and per vehicle. A caller
  // that has less than an even part of all may have as many although others
  // have taken them. Range [1, 1e6].
  int max_searches = 64;
  int max_searches_per_vehicle = 16;
  // Searches per second and caller; off at 0. Range [0, 1e6].
  double max_search_rate_per_caller = 0.0;
  // Nodes of the aligned path times nodes of the history times directions (2
  // for EITHER), per search: core's SearchOptions::max_comparisons, and `limit`
  // of LIMIT_EXCEEDED. The marks that a FindCandidates call has to search first
  // count too, but for the first of them (search_turns.h). Histories of other
  // vehicles that are passed over do not. Range [1000, 1e12].
  std::int64_t max_search_steps = 300'000'000;

  // Whether vehicles that are created without a word about it store their
  // checks (VehicleSettings.checks), which costs a search every check interval.
  bool store_checks_by_default = false;

  // ---- Memory

  // Resident memory of the process above which new work is refused and idle
  // vehicles are unloaded; 0 means three quarters of the memory of the machine
  // or the control group. Range [0, 2^50].
  std::int64_t max_memory_bytes = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SETTINGS_LIMITS_H_
