// Makes crash states from a recording, verifies each as an operator would,
// opens it as a server does that starts on it, and prints what it then holds;
// for power.py, which says what it must.
//
//   power_states check RECORDING
//       Whether the recording is complete: says where the files differ now from
//       what it makes of them, and ends with 1.
//   power_states open RECORDING NAME=VALUE...
//       A line of JSON for each state.
//         directory=DIR    where states are made
//         store=PATH       of the store's directory, below what was recorded
//         backups=PATH     of a directory of backups to look at too
//         states=N         how many
//         from=NS, to=NS   the power is lost in this time; default: any
//         seed=N
//         dishonour=END    files whose flushes are not honoured
//         drop_damaged_log=1
//         keep_every=N     leaves every Nth state, as it was made, in
//                          DIR/kept-<state>
#include <openssl/evp.h>

#include <algorithm>
#include <cinttypes>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <future>
#include <map>
#include <memory>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "crash_states.h"
#include "server/storage/sqlite/sqlite_reader.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "server/storage/sqlite/store_check.h"

namespace revisit::faults {
namespace {

using server::BatchRecord;
using server::BatchVersion;
using server::PairKind;
using server::PosePairRecord;
using server::Storage;
using server::VehicleRecord;

constexpr char kStoreFile[] = "revisit.sqlite";

using Arguments = std::map<std::string, std::string>;

std::uint64_t Number(const Arguments& arguments, const char* name) {
  const auto found = arguments.find(name);
  return found == arguments.end()
             ? 0
             : std::strtoull(found->second.c_str(), nullptr, 10);
}

std::string Text(const Arguments& arguments, const char* name) {
  const auto found = arguments.find(name);
  return found == arguments.end() ? "" : found->second;
}

std::string Quoted(absl::string_view text) {
  std::string quoted = "\"";
  for (const char c : text) {
    if (c == '"' || c == '\\') quoted += '\\';
    quoted += c < ' ' || c > '~' ? '?' : c;
  }
  return quoted + "\"";
}

class Digest {
 public:
  Digest() : context_(EVP_MD_CTX_new()) {
    EVP_DigestInit_ex(context_, EVP_sha256(), nullptr);
  }
  ~Digest() { EVP_MD_CTX_free(context_); }
  Digest(const Digest&) = delete;
  Digest& operator=(const Digest&) = delete;

  void Add(const std::string& bytes) {
    EVP_DigestUpdate(context_, bytes.data(), bytes.size());
  }

  std::string Hexadecimal() {
    unsigned char bytes[EVP_MAX_MD_SIZE];
    unsigned int size = 0;
    EVP_DigestFinal_ex(context_, bytes, &size);
    std::string text;
    for (unsigned int i = 0; i < size; ++i) {
      char digits[3];
      std::snprintf(digits, sizeof(digits), "%02x", bytes[i]);
      text += digits;
    }
    return text;
  }

 private:
  EVP_MD_CTX* const context_;
};

// The digest of the payloads of all batches, one behind the other, is that of
// all their poses, however they are batched.
absl::StatusOr<std::string> DigestOfPoses(Storage& storage,
                                          const VehicleRecord& vehicle,
                                          BatchVersion version) {
  Digest digest;
  if (vehicle.durable_sequence > 0) {
    const absl::Status read =
        storage.ReadBatches(vehicle.key, 1, vehicle.durable_sequence, version,
                            [&](const BatchRecord& batch) {
                              digest.Add(batch.payload);
                              return true;
                            });
    if (!read.ok()) return read;
  }
  return digest.Hexadecimal();
}

absl::StatusOr<std::string> PairsOf(Storage& storage, server::VehicleKey key,
                                    PairKind kind) {
  const absl::StatusOr<std::vector<PosePairRecord>> pairs =
      storage.ListPosePairs(key, kind, "", 1 << 20);
  if (!pairs.ok()) return pairs.status();
  std::string text;
  for (const PosePairRecord& pair : *pairs) {
    text += (text.empty() ? "" : ",") + ("[" + Quoted(pair.id)) + "," +
            std::to_string(pair.query_sequence) + "," +
            std::to_string(pair.matched_sequence) + "," +
            std::to_string(pair.create_time_ns) + "]";
  }
  return "[" + text + "]";
}

absl::StatusOr<std::string> Described(Storage& storage,
                                      const VehicleRecord& vehicle) {
  const auto sent = DigestOfPoses(storage, vehicle, BatchVersion::kAsSent);
  if (!sent.ok()) return sent.status();
  const auto current = DigestOfPoses(storage, vehicle, BatchVersion::kCurrent);
  if (!current.ok()) return current.status();
  const auto closures = PairsOf(storage, vehicle.key, PairKind::kLoopClosure);
  if (!closures.ok()) return closures.status();
  const auto rejected =
      PairsOf(storage, vehicle.key, PairKind::kRejectedCandidate);
  if (!rejected.ok()) return rejected.status();
  return "{\"durable\":" + std::to_string(vehicle.durable_sequence) +
         ",\"revision\":" + std::to_string(vehicle.revision) + ",\"sent\":\"" +
         *sent + "\",\"current\":\"" + *current +
         "\",\"loop_closure\":" + *closures +
         ",\"rejected_candidate\":" + *rejected + "}";
}

// {"vehicles": ...}, or {"refused": why}.
std::string Described(const absl::StatusOr<std::unique_ptr<Storage>>& storage) {
  const auto refused = [](const absl::Status& status) {
    return "{\"refused\":" + Quoted(status.ToString()) + "}";
  };
  if (!storage.ok()) return refused(storage.status());
  const absl::StatusOr<std::vector<VehicleRecord>> vehicles =
      (*storage)->ListVehicles("", "", 1 << 20);
  if (!vehicles.ok()) return refused(vehicles.status());
  std::string text;
  for (const VehicleRecord& vehicle : *vehicles) {
    const absl::StatusOr<std::string> described = Described(**storage, vehicle);
    if (!described.ok()) return refused(described.status());
    text += (text.empty() ? "" : ",") + Quoted(vehicle.id) + ":" + *described;
  }
  return "{\"vehicles\":{" + text + "}}";
}

// Whether the store takes on what comes next of each vehicle.
absl::Status WriteToAll(Storage& storage) {
  const absl::StatusOr<std::vector<VehicleRecord>> vehicles =
      storage.ListVehicles("", "", 1 << 20);
  if (!vehicles.ok()) return vehicles.status();
  for (const VehicleRecord& vehicle : *vehicles) {
    BatchRecord batch;
    batch.first_sequence = vehicle.durable_sequence + 1;
    batch.count = 1;
    batch.revision = vehicle.revision + 1;
    batch.payload = "what comes next";
    std::promise<absl::Status> done;
    storage.AppendBatches(
        vehicle.key, {batch}, std::nullopt,
        [&](absl::Status status) { done.set_value(std::move(status)); });
    const absl::Status status = done.get_future().get();
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

std::string OpenStore(const std::string& directory, bool drop_damaged_log) {
  // As a start does.
  std::filesystem::create_directories(directory);
  server::SqliteOptions options;
  options.drop_damaged_log = drop_damaged_log;
  absl::StatusOr<std::unique_ptr<Storage>> storage =
      server::OpenSqliteStorage(directory + "/" + kStoreFile, options);
  const std::string described = Described(storage);
  if (!storage.ok()) return described;
  const absl::Status written = WriteToAll(**storage);
  if (written.ok()) return described;
  return "{\"refused\":" + Quoted("a write: " + written.ToString()) + "}";
}

// As `revisitd verify`.
absl::Status Verified(const std::string& path) {
  const absl::StatusOr<server::StoreReport> report =
      server::CheckStore(path, server::StoreUse::kIdle);
  if (!report.ok()) return report.status();
  if (report->problems.empty()) return absl::OkStatus();
  return absl::DataLossError(report->problems.front());
}

std::string LookAtBackup(const std::string& path) {
  const absl::Status verified = Verified(path);
  if (!verified.ok()) return Described(verified);
  return Described(server::OpenSqliteStorageToRead(
      path, server::SqliteDatabase::Mode::kFileOnly));
}

// {name: what it holds, ...}
std::string LookAtBackups(const std::string& directory) {
  std::vector<std::string> names;
  for (const auto& entry : std::filesystem::directory_iterator(directory)) {
    if (entry.path().extension() == ".sqlite") {
      names.push_back(entry.path().filename().string());
    }
  }
  std::string text;
  for (const std::string& name : names) {
    text += (text.empty() ? "" : ",") + Quoted(name) + ":" +
            LookAtBackup(directory + "/" + name);
  }
  return "{" + text + "}";
}

// When the power is lost, in nanoseconds.
struct Span {
  std::uint64_t from;
  // 0: the end of the recording.
  std::uint64_t to;
};

// Where the power is lost: before the events of these numbers. Every second one
// is right after a flush or a change of a directory, or next to it.
std::vector<std::size_t> CrashPoints(const std::vector<Event>& events,
                                     std::size_t count, const Span& span,
                                     std::uint64_t seed) {
  std::size_t first = 0;
  while (events[first].header.kind != EventKind::kBegin) ++first;
  while (first + 1 < events.size() &&
         events[first + 1].header.time_ns < span.from) {
    ++first;
  }
  std::size_t last = events.size();
  while (span.to > 0 && last > first + 1 &&
         events[last - 1].header.time_ns > span.to) {
    --last;
  }
  std::vector<std::size_t> turns = {first};
  for (std::size_t i = first; i < last; ++i) {
    const EventKind kind = events[i].header.kind;
    if (kind != EventKind::kWrite && kind != EventKind::kMapped) {
      turns.push_back(i);
    }
  }
  Device::Random random(seed);
  const auto between = [&](std::size_t begin, std::size_t end) {
    return std::uniform_int_distribution<std::size_t>(begin, end)(random);
  };
  std::vector<std::size_t> points;
  for (std::size_t i = 0; i < count; ++i) {
    const std::size_t point =
        i % 2 == 0 ? between(first + 1, last)
                   : turns[between(0, turns.size() - 1)] + between(0, 3);
    points.push_back(std::clamp(point, first + 1, last));
  }
  std::sort(points.begin(), points.end());
  return points;
}

int Open(const std::string& recording, const Arguments& arguments) {
  const std::vector<Event> events = ReadRecording(recording);
  const std::uint64_t seed = Number(arguments, "seed");
  const std::uint64_t keep_every = Number(arguments, "keep_every");
  const std::string parent = Text(arguments, "directory");
  const std::string backups = Text(arguments, "backups");
  const std::vector<std::size_t> points =
      CrashPoints(events, Number(arguments, "states"),
                  {Number(arguments, "from"), Number(arguments, "to")}, seed);
  Device device(Text(arguments, "dishonour"));
  std::size_t applied = 0;
  for (std::size_t i = 0; i < points.size(); ++i) {
    while (applied < points[i]) device.Apply(events[applied++]);
    const Device::Random random(seed + 1 + i);
    const std::string state = parent + "/state";
    std::filesystem::remove_all(state);
    device.WriteState(random, state);
    if (keep_every > 0 && i % keep_every == 0) {
      device.WriteState(random, parent + "/kept-" + std::to_string(i));
    }
    const std::string looked_at =
        backups.empty() ? "{}" : LookAtBackups(state + "/" + backups);
    const std::string store = state + "/" + Text(arguments, "store");
    const absl::Status verified = Verified(store + "/" + kStoreFile);
    const std::string opened =
        OpenStore(store, Number(arguments, "drop_damaged_log") != 0);
    // Who got an answer before this moment got it before the power was lost.
    const std::uint64_t time = points[i] < events.size()
                                   ? events[points[i]].header.time_ns
                                   : std::uint64_t{1} << 62;
    std::printf("{\"state\":%zu,\"event\":%zu,\"time\":%" PRIu64
                ",\"verified\":%s,\"store\":%s,\"backups\":%s}\n",
                i, points[i], time, Quoted(verified.ToString()).c_str(),
                opened.c_str(), looked_at.c_str());
    std::filesystem::remove_all(state);
  }
  return 0;
}

std::map<std::string, std::string> FilesBelow(const std::string& root) {
  std::map<std::string, std::string> files;
  for (const auto& entry :
       std::filesystem::recursive_directory_iterator(root)) {
    const std::string path = entry.path().string();
    if (path.size() > 4 && path.compare(path.size() - 4, 4, "-shm") == 0) {
      continue;
    }
    std::string& content = files[path.substr(root.size())];
    if (entry.is_directory()) continue;
    std::ostringstream bytes;
    bytes << std::ifstream(path, std::ios::binary).rdbuf();
    content = bytes.str();
  }
  return files;
}

int Check(const std::string& recording) {
  const std::vector<Event> events = ReadRecording(recording);
  Device device("");
  for (const Event& event : events) device.Apply(event);
  const std::string made = recording + ".made";
  std::filesystem::remove_all(made);
  device.WriteAll(made);
  const std::map<std::string, std::string> expected =
      FilesBelow(events.front().name);
  const std::map<std::string, std::string> found = FilesBelow(made);
  std::filesystem::remove_all(made);
  if (expected == found) return 0;
  for (const auto* files : {&expected, &found}) {
    for (const auto& [name, content] : *files) {
      const auto& others = files == &expected ? found : expected;
      const auto other = others.find(name);
      if (other == others.end() || other->second != content) {
        std::printf("%s: %zu bytes %s\n", name.c_str(), content.size(),
                    files == &expected ? "are there" : "were recorded");
      }
    }
  }
  return 1;
}

int Main(int count, char** arguments) {
  const std::string task = count > 2 ? arguments[1] : "";
  Arguments named;
  for (int i = 3; i < count; ++i) {
    const std::string argument = arguments[i];
    const std::size_t equals = argument.find('=');
    if (equals == std::string::npos) return 64;
    named[argument.substr(0, equals)] = argument.substr(equals + 1);
  }
  if (task == "check") return Check(arguments[2]);
  if (task == "open") return Open(arguments[2], named);
  std::fprintf(stderr, "usage: see power_states.cc\n");
  return 64;
}

}  // namespace
}  // namespace revisit::faults

int main(int count, char** arguments) {
  return revisit::faults::Main(count, arguments);
}
