#include "server/sessions/vehicle_session.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <deque>
#include <tuple>

#include "server/base/status.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

// Longest that one task replays batches before the strand lets others run.
constexpr std::chrono::milliseconds kReplaySlice{20};

constexpr int kPairsPerRead = 1000;

bool SamePosition(const GeodeticOrigin& a, const GeodeticOrigin& b) {
  return a.latitude_degrees == b.latitude_degrees &&
         a.longitude_degrees == b.longitude_degrees &&
         a.height_meters == b.height_meters;
}

bool MovesNodes(const core::EngineSettings& before,
                const core::EngineSettings& after) {
  const auto is_filter = [](const core::EngineSettings& settings) {
    return settings.search.correlation_model == core::CorrelationModel::kFilter;
  };
  return before.state_space != after.state_space ||
         before.node_spacing_meters != after.node_spacing_meters ||
         before.max_step_meters != after.max_step_meters ||
         is_filter(before) != is_filter(after);
}

// Something that waits for its turn on the strand.
struct Operation {
  // Runs as soon as the vehicle is loaded, whatever else waits, but for a write
  // that would show in the store before it shows in memory.
  bool is_read = false;
  // Runs only while no append is in flight.
  bool needs_quiet = false;
  // Called once, with OK to do it, or with what to answer instead.
  std::function<void(const absl::Status&)> run;
  // Of a read: whether it reads the store too.
  bool reads_store = false;
};

// An append from its staging to its last callback.
struct PendingAppend {
  AppendRequest request;
  // Of all that came, also where only a part is new.
  std::uint64_t first_sequence = 0;
  std::uint64_t last_sequence = 0;
  // Nothing until decoded. Samples and payload are those to write.
  std::optional<DecodedBatch> decoded;
  // Of the write, if there is one; 0 if not.
  std::uint64_t revision = 0;
  // Set when it is known what to answer; answered in order.
  std::optional<absl::Status> result;
};

// A graph in the making from what is stored.
struct Replay {
  VehicleConfig config;
  std::uint64_t revision;
  std::unique_ptr<core::Engine> engine;
  std::vector<core::Jump> jumps;
  std::uint64_t next_sequence = 1;
  // Stands for revisions until the last step: batches have each their own,
  // which do not grow with the sequence once some are revised.
  std::uint64_t steps = 0;
  // Of the batches.
  std::uint64_t highest_revision = 0;
  // Whether it goes only as far as what is stored is sound.
  bool is_load = false;
  std::function<void(const absl::Status&)> then;
};

}  // namespace

absl::Status PoseNotFound(const std::string& vehicle_id, std::uint64_t sequence,
                          std::uint64_t durable_sequence) {
  return Error(StatusCode::kNotFound, "POSE_NOT_FOUND",
               "vehicle '" + vehicle_id + "' has no pose of sequence " +
                   std::to_string(sequence) +
                   (durable_sequence == 0
                        ? ", it has none yet"
                        : ", it has 1 to " + std::to_string(durable_sequence)),
               {{"sequence", std::to_string(sequence)},
                {"durable_sequence", std::to_string(durable_sequence)}});
}

absl::Status CheckMeant(const std::string& vehicle_id,
                        const VehicleConfig& config,
                        const std::string& expected_uid) {
  if (expected_uid.empty() || expected_uid == config.uid) {
    return absl::OkStatus();
  }
  return Error(
      StatusCode::kFailedPrecondition, "VEHICLE_REPLACED",
      "vehicle '" + vehicle_id + "' has the uid " + config.uid + ", got " +
          expected_uid +
          ": it was made anew, and what was acknowledged was of "
          "another vehicle of this name",
      {{"vehicle_uid", config.uid}, {"expected_vehicle_uid", expected_uid}});
}

// Everything but what is constant or atomic belongs to the strand.
struct VehicleSession::State
    : std::enable_shared_from_this<VehicleSession::State> {
  State(std::string vehicle_id, Storage* vehicle_storage,
        const RecordCodec* record_codec, const Lanes& lanes,
        const Limits& session_limits)
      : id(std::move(vehicle_id)),
        storage(vehicle_storage),
        codec(record_codec),
        limits(session_limits),
        strand(Strand::Create(lanes)) {}

  const std::string id;
  Storage* const storage;
  const RecordCodec* const codec;
  const Limits limits;
  const std::shared_ptr<Strand> strand;
  std::atomic<int> pending_appends{0};
  std::atomic<bool> is_gone{false};
  // Whether GiveUpReplay() was called.
  std::atomic<bool> gives_up_replay{false};
  // See VehicleSession::Residency.
  std::atomic<std::int64_t> resident_nodes{0};
  std::atomic<std::int64_t> resident_bytes{0};

  // What is durable and applied. No engine until loaded.
  VehicleKey key = 0;
  VehicleConfig config;
  std::unique_ptr<core::Engine> engine;
  // Of the graph, by sequence.
  std::vector<core::Jump> jumps;
  std::uint64_t durable_sequence = 0;
  std::uint64_t revision = 0;
  PosePairs loop_closures;
  PosePairs rejections;
  // Of both; nothing if there are none.
  std::optional<std::int64_t> latest_pair_ns;
  // See VehicleView; while it is loaded, the first cause.
  absl::Status damage;
  bool config_is_known = true;

  // The same with what is in flight.
  std::uint64_t staged_sequence = 0;
  std::uint64_t staged_revision = 0;
  VehicleConfig staged_config;

  // Appends that were staged or refused, oldest first, until answered.
  std::deque<std::shared_ptr<PendingAppend>> in_flight;
  // Why the first of them failed that did; the writes behind it fail too.
  std::optional<absl::Status> failure;
  // What must wait, oldest first.
  std::deque<Operation> waiting;
  bool pumping = false;
  // Loading or changing: nothing but reads may run.
  bool exclusive = false;
  // The stored poses are, or may be at any moment, what the vehicle's will be
  // and are not yet.
  bool poses_are_ahead = false;
  // The same of the vehicle: it is gone in the store, or its pairs are not yet
  // in the graph.
  bool vehicle_is_ahead = false;
  // The checks of an append that has landed are still to be run. What is in
  // flight behind it lands after them.
  bool checking = false;
  // A write failed: see that the store has what this session thinks it has.
  bool in_doubt = false;
  std::optional<Replay> replay;
  // What to answer to everything.
  std::optional<absl::Status> gone_status;

  VehicleView View() const {
    return VehicleView{id,
                       config,
                       *engine,
                       key,
                       durable_sequence,
                       revision,
                       static_cast<std::int64_t>(loop_closures.size()),
                       &loop_closures,
                       &rejections,
                       damage,
                       config_is_known};
  }

  PosePairs& Pairs(PairKind kind) {
    return kind == PairKind::kLoopClosure ? loop_closures : rejections;
  }

  // After every change of a graph.
  void NoteResidency() {
    std::int64_t nodes = 0;
    std::int64_t bytes = 0;
    const core::Engine* const engines[] = {
        engine.get(), replay ? replay->engine.get() : nullptr};
    for (const core::Engine* const of : engines) {
      if (of == nullptr) continue;
      nodes += of->graph().size();
      bytes += static_cast<std::int64_t>(of->bytes());
    }
    resident_nodes.store(nodes);
    resident_bytes.store(bytes);
  }

  using ViewCallback = std::function<void(absl::StatusOr<VehicleView>)>;

  Operation Reading(ViewCallback callback) {
    return {true, false,
            [this, callback = std::move(callback)](const absl::Status& status) {
              if (status.ok()) {
                callback(View());
              } else {
                callback(status);
              }
            }};
  }

  // ---- The queue

  // From any thread.
  void Submit(Operation operation) {
    strand->Post(Adding(std::move(operation)));
  }

  void SubmitLong(Operation operation) {
    strand->PostLong(Adding(std::move(operation)));
  }

  void SubmitSearch(Operation operation) {
    strand->PostSearch(Adding(std::move(operation)));
  }

  std::function<void()> Adding(Operation operation) {
    return [self = shared_from_this(),
            operation = std::move(operation)]() mutable {
      self->Add(std::move(operation));
    };
  }

  // The same for an append, which is staged before this returns if nothing
  // stands in its way. So the caller's thread does what it would else have
  // woken another for.
  void SubmitAppend(std::shared_ptr<PendingAppend> append) {
    strand->RunOrPost(
        [self = shared_from_this(), append = std::move(append)]() mutable {
          self->AddAppend(std::move(append));
        });
  }

  void AddAppend(std::shared_ptr<PendingAppend> append) {
    if (waiting.empty() && !gone_status && !exclusive && !failure &&
        !in_doubt) {
      RunAppend(append, absl::OkStatus(), /*may_read=*/false);
      return;
    }
    waiting.push_back(
        {false, false,
         [this, append = std::move(append)](const absl::Status& status) {
           RunAppend(append, status, /*may_read=*/true);
         }});
    PumpLater();
  }

  void PumpLater() {
    strand->Post([self = shared_from_this()] { self->Pump(); });
  }

  void Add(Operation operation) {
    if (operation.is_read && (engine != nullptr || gone_status) &&
        !MustWait(operation)) {
      operation.run(gone_status.value_or(absl::OkStatus()));
      return;
    }
    waiting.push_back(std::move(operation));
    Pump();
  }

  // Runs what may run.
  void Pump() {
    if (pumping) return;
    pumping = true;
    while (!waiting.empty() && MayRun(waiting.front())) {
      Operation operation = std::move(waiting.front());
      waiting.pop_front();
      if (operation.reads_store && !gone_status) {
        SubmitLong(std::move(operation));
        continue;
      }
      absl::Status status = gone_status.value_or(absl::OkStatus());
      if (status.ok() && !operation.is_read) status = ClearDoubt();
      operation.run(status);
    }
    pumping = false;
  }

  // Of a read: whether it could show what a later one does not.
  bool MustWait(const Operation& operation) const {
    return !gone_status &&
           (vehicle_is_ahead || (poses_are_ahead && operation.reads_store));
  }

  bool MayRun(const Operation& operation) const {
    if (gone_status) return true;
    if (exclusive) return false;
    if (operation.is_read) return true;
    if (failure) return false;
    return !operation.needs_quiet || (in_flight.empty() && !checking);
  }

  // After a failed write: OK if store and memory agree.
  absl::Status ClearDoubt() {
    if (!in_doubt || !in_flight.empty() || checking) return absl::OkStatus();
    const absl::StatusOr<VehicleRecord> record = storage->GetVehicle(id);
    if (!record.ok()) {
      if (absl::IsNotFound(record.status())) Leave(VehicleNotFound(id));
      return record.status();
    }
    if (record->key != key || record->durable_sequence != durable_sequence ||
        record->revision != revision ||
        record->loop_closure_count !=
            static_cast<std::int64_t>(loop_closures.size()) ||
        record->rejected_candidate_count !=
            static_cast<std::int64_t>(rejections.size()) ||
        !record->damage.ok() || !damage.ok()) {
      Leave(OutOfStep());
      return *gone_status;
    }
    in_doubt = false;
    return absl::OkStatus();
  }

  static absl::Status ShuttingDown() {
    return Error(StatusCode::kUnavailable, "SERVER_DRAINING",
                 "the server is shutting down");
  }

  absl::Status OutOfStep() const {
    return Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                 "vehicle '" + id +
                     "' has to be loaded anew, since it and the store "
                     "disagree; try again");
  }

  // From now on everything is answered with `status`.
  void Leave(const absl::Status& status) {
    gone_status = status;
    is_gone.store(true);
  }

  // ---- Loading and rebuilding

  void Load() {
    exclusive = true;
    const absl::Status status = StartLoad();
    if (status.ok()) return;
    exclusive = false;
    Leave(absl::IsNotFound(status) ? VehicleNotFound(id) : status);
    Pump();
  }

  absl::Status StartLoad() {
    absl::StatusOr<VehicleRecord> record = storage->GetVehicle(id);
    if (!record.ok()) return record.status();
    key = record->key;
    absl::StatusOr<VehicleConfig> decoded = StoredConfig(*record);
    if (!decoded.ok()) {
      // Poses cannot be read without it.
      config_is_known = false;
      engine = std::make_unique<core::Engine>(config.engine);
      Settled(config, record->revision);
      damage = Damaged(record->damage.ok() ? decoded.status() : record->damage);
      exclusive = false;
      Pump();
      return absl::OkStatus();
    }
    durable_sequence = record->durable_sequence;
    for (const PairKind kind : kPairKinds) {
      const absl::Status read = LoadPairs(kind);
      if (!read.ok()) return read;
    }
    StartReplay(
        *std::move(decoded), record->revision,
        [this](const absl::Status& status) {
          if (!status.ok()) Leave(status);
          if (!damage.ok()) damage = Damaged(damage);
        },
        /*is_load=*/true);
    return absl::OkStatus();
  }

  absl::StatusOr<VehicleConfig> StoredConfig(
      const VehicleRecord& record) const {
    absl::StatusOr<VehicleConfig> decoded = codec->DecodeVehicle(record);
    if (!decoded.ok()) return decoded;
    const std::vector<core::SettingProblem> problems =
        core::FindProblems(decoded->engine);
    if (!problems.empty()) {
      return Corrupt("stored settings: " + problems.front().field + ": " +
                     problems.front().description);
    }
    return decoded;
  }

  void NoteDamage(const absl::Status& cause) {
    if (damage.ok()) damage = cause;
  }

  absl::Status Damaged(const absl::Status& cause) const {
    const std::string durable = std::to_string(durable_sequence);
    return Error(
        StatusCode::kDataLoss, "STORE_CORRUPT",
        "vehicle '" + id + "' is damaged: " + std::string(cause.message()) +
            (config_is_known
                 ? "; " + durable +
                       " poses before it are sound and can be read, writes "
                       "and searches are refused until an operator gives up "
                       "the rest (AcceptDataLoss with durable_sequence " +
                       durable + ") or deletes the vehicle"
                 : "; without its settings it can only be deleted"),
        {{"vehicle", id}, {"durable_sequence", durable}});
  }

  absl::Status LoadPairs(PairKind kind) {
    std::string after;
    while (true) {
      const absl::StatusOr<std::vector<PosePairRecord>> page =
          storage->ListPosePairs(key, kind, after, kPairsPerRead);
      if (absl::IsDataLoss(page.status())) {
        NoteDamage(page.status());
        return absl::OkStatus();
      }
      if (!page.ok()) return page.status();
      if (page->empty()) return absl::OkStatus();
      after = page->back().id;
      for (const PosePairRecord& pair : *page) {
        if (pair.damage.ok()) {
          Pairs(kind).emplace(pair.id, pair);
        } else {
          NoteDamage(pair.damage);
        }
      }
    }
  }

  // Makes a graph from what is stored; when done, that becomes the vehicle's,
  // with this config and revision. Reads see the old one until then.
  void StartReplay(VehicleConfig new_config, std::uint64_t new_revision,
                   std::function<void(const absl::Status&)> then,
                   bool is_load = false) {
    exclusive = true;
    replay.emplace();
    replay->is_load = is_load;
    replay->config = std::move(new_config);
    replay->revision = new_revision;
    replay->engine = std::make_unique<core::Engine>(replay->config.engine);
    replay->then = std::move(then);
    PostReplay();
  }

  void PostReplay() {
    strand->PostLong([self = shared_from_this()] { self->ContinueReplay(); });
  }

  void ContinueReplay() {
    absl::StatusOr<bool> finished = ReplaySome();
    if (finished.ok() && !*finished && gives_up_replay) {
      finished = ShuttingDown();
    }
    if (finished.ok() && !*finished) {
      NoteResidency();
      PostReplay();
      return;
    }
    Replay done = *std::move(replay);
    replay.reset();
    poses_are_ahead = false;
    vehicle_is_ahead = false;
    if (finished.ok()) {
      engine = std::move(done.engine);
      jumps = std::move(done.jumps);
      Settled(done.config, done.revision);
    }
    NoteResidency();
    exclusive = false;
    done.then(finished.status());
    Pump();
  }

  // Answers whether the graph is complete.
  absl::StatusOr<bool> ReplaySome() {
    const auto pause = std::chrono::steady_clock::now() + kReplaySlice;
    if (replay->next_sequence <= durable_sequence) {
      absl::Status decoding;
      const absl::Status reading = storage->ReadBatches(
          key, replay->next_sequence, durable_sequence, BatchVersion::kCurrent,
          [&](const BatchRecord& batch) {
            const absl::StatusOr<DecodedBatch> decoded =
                DecodeStored(batch, replay->config);
            if (!decoded.ok()) {
              decoding = decoded.status();
              return false;
            }
            const core::AppendResult applied =
                replay->engine->Append(decoded->samples, ++replay->steps);
            replay->jumps.insert(replay->jumps.end(), applied.jumps.begin(),
                                 applied.jumps.end());
            replay->highest_revision =
                std::max(replay->highest_revision, batch.revision);
            replay->next_sequence = batch.first_sequence + batch.count;
            return std::chrono::steady_clock::now() < pause;
          });
      const absl::Status& unread = reading.ok() ? decoding : reading;
      if (replay->is_load && absl::IsDataLoss(unread)) {
        GoNoFurther(unread);
      } else if (!unread.ok()) {
        return unread;
      }
      if (replay->next_sequence <= durable_sequence) return false;
    }
    if (const absl::Status status = CheckPairs(); !status.ok()) return status;
    FindLatestPair();
    for (const auto& [kind, pair] : PairsAsAdded()) {
      Apply(replay->engine.get(), kind, *pair, ++replay->steps);
    }
    if (replay->steps >= replay->revision) {
      const absl::Status status =
          Corrupt("stored revision " + std::to_string(replay->revision) +
                  " is less than the number of changes");
      if (!replay->is_load) return status;
      NoteDamage(status);
      replay->revision = replay->steps + 1;
    }
    replay->engine->ChangeSettings(replay->config.engine, replay->revision);
    return true;
  }

  // The poses from the next one on cannot be read. Each of them may have
  // brought a revision, and those must not come again.
  void GoNoFurther(const absl::Status& cause) {
    NoteDamage(cause);
    const std::uint64_t sound = replay->next_sequence - 1;
    replay->revision = std::max(replay->revision, replay->highest_revision) +
                       (durable_sequence - sound);
    durable_sequence = sound;
  }

  // Pairs name poses that are there. Loading leaves out others.
  absl::Status CheckPairs() {
    for (const PairKind kind : kPairKinds) {
      PosePairs& pairs = Pairs(kind);
      for (auto i = pairs.begin(); i != pairs.end();) {
        const PosePairRecord& pair = i->second;
        if (pair.matched_sequence >= 1 &&
            pair.query_sequence <= durable_sequence) {
          ++i;
          continue;
        }
        const absl::Status status =
            Corrupt("stored " + std::string(WordsOf(kind).noun) + " '" +
                    pair.id + "' names a pose that is not stored");
        if (!replay->is_load) return status;
        NoteDamage(status);
        i = pairs.erase(i);
      }
    }
    return absl::OkStatus();
  }

  // In the order in which they were added, all kinds together, so that graph
  // and consistency come out the same as before.
  std::vector<std::pair<PairKind, const PosePairRecord*>> PairsAsAdded() {
    std::vector<std::pair<PairKind, const PosePairRecord*>> added;
    for (const PairKind kind : kPairKinds) {
      for (const auto& entry : Pairs(kind)) {
        added.emplace_back(kind, &entry.second);
      }
    }
    std::sort(added.begin(), added.end(), [](const auto& a, const auto& b) {
      return std::tie(a.second->create_time_ns, a.second->id, a.first) <
             std::tie(b.second->create_time_ns, b.second->id, b.first);
    });
    return added;
  }

  static void Apply(core::Engine* engine, PairKind kind,
                    const PosePairRecord& pair, std::uint64_t revision) {
    if (kind == PairKind::kLoopClosure) {
      engine->AddLoopClosure(pair.query_sequence, pair.matched_sequence,
                             revision);
    } else {
      engine->AddRejection(pair.query_sequence, pair.matched_sequence,
                           revision);
    }
  }

  // Of a pair that is still among Pairs().
  void TakeBack(PairKind kind, const PosePairRecord& pair, std::uint64_t next) {
    if (kind == PairKind::kRejectedCandidate) {
      engine->RemoveRejection(pair.query_sequence, pair.matched_sequence, next);
      return;
    }
    // The same poses may be named more than once, and what the others teach
    // depends on their order.
    std::size_t occurrence = 0;
    for (const auto& [other_kind, other] : PairsAsAdded()) {
      if (other_kind != kind) continue;
      if (other->id == pair.id) break;
      if (other->query_sequence == pair.query_sequence &&
          other->matched_sequence == pair.matched_sequence) {
        ++occurrence;
      }
    }
    engine->RemoveLoopClosure(pair.query_sequence, pair.matched_sequence, next,
                              occurrence);
  }

  absl::StatusOr<DecodedBatch> DecodeStored(
      const BatchRecord& batch, const VehicleConfig& with_config) const {
    absl::StatusOr<DecodedBatch> decoded =
        codec->DecodeBatch(batch.payload, with_config);
    if (!decoded.ok()) return decoded;
    bool fits = decoded->samples.size() == batch.count &&
                decoded->fingerprints.size() == batch.count;
    for (std::size_t i = 0; fits && i < decoded->samples.size(); ++i) {
      fits = decoded->samples[i].sequence == batch.first_sequence + i;
    }
    if (!fits) {
      return Corrupt("stored batch of " + std::to_string(batch.count) +
                     " poses from sequence " +
                     std::to_string(batch.first_sequence) +
                     " holds others than these");
    }
    return decoded;
  }

  absl::Status Corrupt(const std::string& what) const {
    return Error(StatusCode::kDataLoss, "STORE_CORRUPT",
                 "vehicle '" + id + "': " + what, {{"vehicle", id}});
  }

  // Nothing is in flight and this is the vehicle's state.
  void Settled(const VehicleConfig& new_config, std::uint64_t new_revision) {
    config = new_config;
    revision = new_revision;
    staged_config = config;
    staged_sequence = durable_sequence;
    staged_revision = revision;
  }

  // ---- Appends

  // `may_read`: whether this thread may wait for the storage.
  void RunAppend(const std::shared_ptr<PendingAppend>& append,
                 const absl::Status& status, bool may_read) {
    const absl::StatusOr<Staging> staged =
        status.ok() ? Stage(append, may_read) : status;
    if (!staged.ok()) {
      // Answered behind those before it.
      append->result = staged.status();
      in_flight.push_back(append);
      Staged(append, staged.status());
      Settle();
    } else if (*staged != Staging::kDone) {
      // Goes first: once all that is in flight has landed, or on a thread of
      // the executor.
      waiting.push_front({false, *staged == Staging::kWhenQuiet,
                          [this, append](const absl::Status& s) {
                            RunAppend(append, s, /*may_read=*/true);
                          }});
      if (!may_read) PumpLater();
    }
  }

  static void Staged(const std::shared_ptr<PendingAppend>& append,
                     const absl::Status& status) {
    append->request.decoder = nullptr;
    const auto staged = std::move(append->request.callbacks.staged);
    if (staged) staged(status);
  }

  // Whether an append was taken on, or when it can be judged.
  enum class Staging { kDone, kWhenQuiet, kWhereReadsMayWait };

  absl::StatusOr<Staging> Stage(const std::shared_ptr<PendingAppend>& append,
                                bool may_read) {
    const absl::Status writable = Writable();
    if (!writable.ok()) return writable;
    if (!append->decoded) {
      absl::StatusOr<DecodedBatch> decoded =
          append->request.decoder(staged_config);
      if (!decoded.ok()) return decoded.status();
      const absl::Status checked = CheckConsecutive(*decoded);
      if (!checked.ok()) return checked;
      append->decoded = *std::move(decoded);
    }
    DecodedBatch& batch = *append->decoded;
    const std::uint64_t first = batch.samples.front().sequence;
    const std::uint64_t last = batch.samples.back().sequence;
    append->first_sequence = first;
    append->last_sequence = last;
    if (first > staged_sequence + 1) {
      const std::string expected = std::to_string(staged_sequence + 1);
      return Error(StatusCode::kFailedPrecondition, "SEQUENCE_GAP",
                   "vehicle '" + id + "': got a batch from sequence " +
                       std::to_string(first) + ", expected " + expected,
                   {{"expected_sequence", expected}});
    }
    if (first <= staged_sequence) {
      if (last > durable_sequence && staged_sequence > durable_sequence) {
        return Staging::kWhenQuiet;
      }
      if (!may_read) return Staging::kWhereReadsMayWait;
      const absl::Status same =
          CompareWithStored(batch, first, std::min(last, durable_sequence));
      if (!same.ok()) return same;
      if (last <= durable_sequence) {
        append->result = absl::OkStatus();
        in_flight.push_back(append);
        Staged(append, absl::OkStatus());
        Settle();
        return Staging::kDone;
      }
      const absl::Status sliced =
          KeepFrom(durable_sequence + 1 - first, &batch);
      if (!sliced.ok()) return sliced;
    }
    const absl::Status origin = StageOrigin(batch);
    if (!origin.ok()) return origin;
    Write(append);
    return Staging::kDone;
  }

  // The first batch of a geodetic vehicle may set its origin.
  absl::Status StageOrigin(const DecodedBatch& batch) {
    if (!batch.origin) return absl::OkStatus();
    if (!staged_config.origin) {
      staged_config.origin = batch.origin;
      return absl::OkStatus();
    }
    if (!SamePosition(*staged_config.origin, *batch.origin)) {
      return Error(StatusCode::kInternal, "INTERNAL",
                   "vehicle '" + id +
                       "': a batch was decoded with another geodetic origin");
    }
    return absl::OkStatus();
  }

  void Write(const std::shared_ptr<PendingAppend>& append) {
    DecodedBatch& batch = *append->decoded;
    BatchRecord record;
    record.first_sequence = batch.samples.front().sequence;
    record.count = static_cast<std::uint32_t>(batch.samples.size());
    record.revision = ++staged_revision;
    record.payload = std::move(batch.payload);
    std::optional<std::string> vehicle_payload;
    if (staged_config.origin && !config.origin && record.first_sequence == 1) {
      vehicle_payload = codec->EncodeVehicle(staged_config);
    }
    append->revision = record.revision;
    staged_sequence = batch.samples.back().sequence;
    in_flight.push_back(append);
    Staged(append, absl::OkStatus());
    storage->AppendBatch(
        key, std::move(record), std::move(vehicle_payload),
        [self = shared_from_this(), append](const absl::Status& status) {
          self->strand->Post([self, append, status] {
            append->result = status;
            self->Settle();
            self->Pump();
          });
        });
  }

  static absl::Status CheckConsecutive(const DecodedBatch& batch) {
    if (batch.samples.empty()) {
      return InvalidFields("BATCH_SIZE", {{"poses", "got 0, at least 1"}});
    }
    const std::uint64_t first = batch.samples.front().sequence;
    if (first == 0) {
      return InvalidFields("INVALID_FIELD",
                           {{"poses[0].sequence", "got 0, at least 1"}});
    }
    for (std::size_t i = 0; i < batch.samples.size(); ++i) {
      if (batch.samples[i].sequence != first + i) {
        return InvalidFields(
            "INVALID_FIELD",
            {{"poses[" + std::to_string(i) + "].sequence",
              "got " + std::to_string(batch.samples[i].sequence) +
                  ", in a batch it must be the one before plus 1, " +
                  std::to_string(first + i)}});
      }
    }
    return absl::OkStatus();
  }

  // Whether the poses of [first, last] are stored with the same content.
  absl::Status CompareWithStored(const DecodedBatch& batch, std::uint64_t first,
                                 std::uint64_t last) const {
    absl::Status result;
    const absl::Status reading = storage->ReadBatches(
        key, first, last, BatchVersion::kAsSent,
        [&](const BatchRecord& record) {
          const absl::StatusOr<DecodedBatch> stored =
              DecodeStored(record, config);
          if (!stored.ok()) {
            result = stored.status();
            return false;
          }
          const std::uint64_t from = std::max(first, record.first_sequence);
          const std::uint64_t to =
              std::min(last, record.first_sequence + record.count - 1);
          for (std::uint64_t sequence = from; sequence <= to; ++sequence) {
            if (batch.fingerprints[sequence - first] ==
                stored->fingerprints[sequence - record.first_sequence]) {
              continue;
            }
            result = Error(
                StatusCode::kAlreadyExists, "SEQUENCE_CONTENT_MISMATCH",
                "vehicle '" + id + "': the pose of sequence " +
                    std::to_string(sequence) + " is stored with other content",
                {{"sequence", std::to_string(sequence)}});
            return false;
          }
          return true;
        });
    return reading.ok() ? result : reading;
  }

  absl::Status KeepFrom(std::size_t first, DecodedBatch* batch) const {
    const std::size_t count = batch->samples.size() - first;
    absl::StatusOr<std::string> payload =
        codec->SliceBatch(batch->payload, first, count);
    if (!payload.ok()) return payload.status();
    batch->payload = *std::move(payload);
    const auto offset = static_cast<std::ptrdiff_t>(first);
    batch->samples.erase(batch->samples.begin(),
                         batch->samples.begin() + offset);
    batch->fingerprints.erase(batch->fingerprints.begin(),
                              batch->fingerprints.begin() + offset);
    return absl::OkStatus();
  }

  // Answers, in order, the appends whose result is known.
  void Settle() {
    while (!checking && !in_flight.empty() && in_flight.front()->result) {
      const std::shared_ptr<PendingAppend> append =
          std::move(in_flight.front());
      in_flight.pop_front();
      if (append->revision == 0) {
        Answer(append, *append->result);
      } else {
        Land(append);
      }
    }
    if (in_flight.empty() && !checking && failure) {
      failure.reset();
      Settled(config, revision);
    }
  }

  // A write came back.
  void Land(const std::shared_ptr<PendingAppend>& append) {
    absl::Status status = *append->result;
    if (failure) {
      // Stored behind one that was not: the store is no prefix of what was
      // staged, which its contract rules out.
      if (status.ok()) Leave(OutOfStep());
      status = *failure;
    } else if (!status.ok()) {
      // It expected another batch than this session does.
      if (status.code() == StatusCode::kFailedPrecondition) {
        status = OutOfStep();
      }
      failure = status;
      in_doubt = true;
    }
    if (!status.ok()) {
      Answer(append, status);
      return;
    }
    const std::vector<core::PoseSample>& samples = append->decoded->samples;
    core::AppendResult applied = engine->Append(samples, append->revision);
    jumps.insert(jumps.end(), applied.jumps.begin(), applied.jumps.end());
    NoteResidency();
    durable_sequence = samples.back().sequence;
    revision = append->revision;
    if (!config.origin) config.origin = append->decoded->origin;
    const AppendRequest& request = append->request;
    Answer(append, absl::OkStatus());
    if (!request.check || !request.callbacks.candidates ||
        applied.checks_due.empty()) {
      return;
    }
    checking = true;
    strand->PostSearch([self = shared_from_this(), append,
                        due = std::move(applied.checks_due)] {
      self->Check(append->request, due);
      self->checking = false;
      // In the lane of short work again.
      self->strand->Post([self] {
        self->Settle();
        self->Pump();
      });
    });
  }

  void Check(const AppendRequest& request,
             const std::vector<core::NodeIndex>& due) {
    const absl::StatusOr<core::SearchOptions> options =
        (*request.check)(config);
    for (core::NodeIndex node : due) {
      request.callbacks.candidates(
          View(), options.ok() ? engine->FindCandidates(node, *options,
                                                        request.should_stop)
                               : options.status());
    }
  }

  void Answer(const std::shared_ptr<PendingAppend>& append,
              const absl::Status& status) {
    pending_appends.fetch_sub(1);
    const auto durable = std::move(append->request.callbacks.durable);
    if (!durable) return;
    if (!status.ok()) {
      durable(status);
    } else {
      durable(Acknowledgement{
          durable_sequence, revision,
          JumpsAt(append->first_sequence, append->last_sequence)});
    }
  }

  std::vector<core::Jump> JumpsAt(std::uint64_t first,
                                  std::uint64_t last) const {
    const auto begin =
        std::lower_bound(jumps.begin(), jumps.end(), first,
                         [](const core::Jump& jump, std::uint64_t sequence) {
                           return jump.sequence < sequence;
                         });
    const auto end =
        std::upper_bound(begin, jumps.end(), last,
                         [](std::uint64_t sequence, const core::Jump& jump) {
                           return sequence < jump.sequence;
                         });
    return {begin, end};
  }

  absl::Status Regressed(const std::string& what,
                         ErrorMetadata metadata) const {
    metadata.emplace_back("durable_sequence", std::to_string(durable_sequence));
    return Error(StatusCode::kDataLoss, "DURABLE_SEQUENCE_REGRESSED",
                 "vehicle '" + id + "': " + what, metadata);
  }

  absl::Status DataLoss(const ErrorMetadata& metadata) const {
    return Regressed("a client held an acknowledgement for more than the " +
                         std::to_string(durable_sequence) +
                         " poses that are stored; writes are refused until an "
                         "operator accepts the loss (AcceptDataLoss with "
                         "durable_sequence " +
                         std::to_string(durable_sequence) + ")",
                     metadata);
  }

  // ---- Other changes; they run while nothing is in flight

  absl::Status Writable() const {
    if (!damage.ok()) return damage;
    return config.data_loss ? DataLoss({}) : absl::OkStatus();
  }

  // Hands a write to the storage; `then` runs on the strand when it is done,
  // and nothing but reads until `then` returns.
  void WriteAlone(const std::function<void(Storage::Done)>& write,
                  std::function<void(const absl::Status&)> then) {
    exclusive = true;
    write([self = shared_from_this(),
           then = std::move(then)](const absl::Status& status) {
      self->strand->Post([self, then, status] {
        self->exclusive = false;
        if (!status.ok()) self->in_doubt = true;
        self->pumping = true;
        then(status);
        self->pumping = false;
        self->Pump();
      });
    });
  }

  // Stores and applies a config that moves no nodes.
  void WriteConfig(const VehicleConfig& new_config,
                   std::function<void(const absl::Status&)> then) {
    const std::uint64_t next = revision + 1;
    WriteAlone(
        [&](Storage::Done done) {
          storage->UpdateVehicle(key, codec->EncodeVehicle(new_config), next,
                                 std::move(done));
        },
        [this, new_config, next,
         then = std::move(then)](const absl::Status& status) {
          if (status.ok()) {
            engine->ChangeSettings(new_config.engine, next);
            Settled(new_config, next);
          }
          then(status);
        });
  }

  // Whether a claim is more than is stored, and if not, what to answer to it.
  bool IsOfLostPoses(std::uint64_t acked_sequence,
                     const std::string& vehicle_uid,
                     const ViewCallback& callback) const {
    const absl::Status answer =
        config_is_known ? CheckMeant(id, config, vehicle_uid) : damage;
    if (!answer.ok()) {
      callback(answer);
    } else if (!damage.ok()) {
      callback(damage);
    } else if (acked_sequence > durable_sequence) {
      return true;
    } else {
      callback(View());
    }
    return false;
  }

  void CheckAcknowledged(std::uint64_t acked_sequence,
                         const std::string& vehicle_uid,
                         const ViewCallback& callback) {
    if (!IsOfLostPoses(acked_sequence, vehicle_uid, callback)) return;
    const ErrorMetadata acked = {
        {"acked_sequence", std::to_string(acked_sequence)}};
    if (vehicle_uid.empty() && !config.data_loss) {
      callback(Regressed(
          "the client holds an acknowledgement for sequence " +
              std::to_string(acked_sequence) + ", but only " +
              std::to_string(durable_sequence) +
              " poses are stored; without the uid of the vehicle that it is "
              "of (vehicle_uid) this ends this stream alone",
          acked));
      return;
    }
    const absl::Status loss = DataLoss(acked);
    if (config.data_loss) {
      callback(loss);
      return;
    }
    VehicleConfig new_config = config;
    new_config.data_loss = true;
    WriteConfig(new_config, [this, callback, loss](const absl::Status&) {
      // Holds in memory even if it could not be stored; the client will say so
      // again. Not before: nobody may see what a crash could take back.
      config.data_loss = true;
      callback(loss);
    });
  }

  void AcceptDataLoss(std::uint64_t sequence, const ViewCallback& callback) {
    const ErrorMetadata metadata = {
        {"durable_sequence", std::to_string(durable_sequence)}};
    if (!config_is_known) {
      callback(damage);
      return;
    }
    if (!config.data_loss && damage.ok()) {
      callback(Error(
          StatusCode::kFailedPrecondition, "NO_DATA_LOSS",
          "vehicle '" + id + "' is neither in the state DATA_LOSS nor DAMAGED",
          metadata));
      return;
    }
    if (sequence != durable_sequence) {
      callback(
          Error(StatusCode::kFailedPrecondition, "DURABLE_SEQUENCE_MISMATCH",
                "durable_sequence: got " + std::to_string(sequence) +
                    ", the vehicle's is " + std::to_string(durable_sequence),
                metadata));
      return;
    }
    VehicleConfig new_config = config;
    new_config.data_loss = false;
    const auto answer = [this, callback](const absl::Status& status) {
      if (status.ok()) {
        callback(View());
      } else {
        callback(status);
      }
    };
    if (damage.ok()) {
      WriteConfig(new_config, answer);
    } else {
      DropDamaged(new_config, answer);
    }
  }

  // What is in memory is what stays.
  void DropDamaged(const VehicleConfig& new_config,
                   std::function<void(const absl::Status&)> then) {
    const std::uint64_t next = revision + 1;
    WriteAlone(
        [&](Storage::Done done) {
          storage->DropDamaged(key, durable_sequence,
                               codec->EncodeVehicle(new_config), next,
                               std::move(done));
        },
        [this, new_config, next,
         then = std::move(then)](const absl::Status& status) {
          if (status.ok()) {
            damage = absl::OkStatus();
            engine->ChangeSettings(new_config.engine, next);
            Settled(new_config, next);
          }
          then(status);
        });
  }

  void Update(const std::function<
                  absl::StatusOr<VehicleConfig>(const VehicleView&)>& change,
              const ViewCallback& callback) {
    const absl::Status writable = Writable();
    if (!writable.ok()) {
      callback(writable);
      return;
    }
    const absl::StatusOr<VehicleConfig> changed = change(View());
    if (!changed.ok()) {
      callback(changed.status());
      return;
    }
    const auto answer = [this, callback](const absl::Status& status) {
      if (status.ok()) {
        callback(View());
      } else {
        callback(status);
      }
    };
    if (!MovesNodes(config.engine, changed->engine)) {
      WriteConfig(*changed, answer);
      return;
    }
    const std::uint64_t next = revision + 1;
    WriteAlone(
        [&](Storage::Done done) {
          storage->UpdateVehicle(key, codec->EncodeVehicle(*changed), next,
                                 std::move(done));
        },
        [this, new_config = *changed, next,
         answer](const absl::Status& status) {
          if (!status.ok()) {
            answer(status);
          } else {
            Rebuild(new_config, next, answer);
          }
        });
  }

  // After a change that is stored.
  void Rebuild(const VehicleConfig& new_config, std::uint64_t new_revision,
               std::function<void(const absl::Status&)> then) {
    StartReplay(new_config, new_revision,
                [this, then = std::move(then)](const absl::Status& status) {
                  // The graph in memory is not that of the store any more.
                  if (!status.ok()) Leave(status);
                  then(status);
                });
  }

  using RevisionPlanner =
      std::function<absl::StatusOr<RevisionPlan>(const VehicleView&)>;
  using RevisionCallback = std::function<void(
      absl::StatusOr<std::pair<std::uint64_t, std::int64_t>>)>;

  void Revise(const RevisionPlanner& make_plan,
              const RevisionCallback& callback) {
    const absl::Status writable = Writable();
    if (!writable.ok()) {
      callback(writable);
      return;
    }
    // The plan reads all that it revises.
    exclusive = true;
    strand->PostLong([self = shared_from_this(), make_plan, callback] {
      self->exclusive = false;
      self->pumping = true;
      self->WriteRevision(make_plan, callback);
      self->pumping = false;
      self->Pump();
    });
  }

  void WriteRevision(const RevisionPlanner& make_plan,
                     const RevisionCallback& callback) {
    absl::StatusOr<RevisionPlan> plan = make_plan(View());
    if (!plan.ok()) {
      callback(plan.status());
      return;
    }
    if (plan->done_by) {
      callback(std::make_pair(*plan->done_by, plan->revised_count));
      return;
    }
    if (!plan->batches) {
      callback(std::make_pair(revision, std::int64_t{0}));
      return;
    }
    const std::uint64_t next = revision + 1;
    const auto answer = [this, callback, count = plan->revised_count](
                            const absl::Status& status) {
      if (status.ok()) {
        callback(std::make_pair(revision, count));
      } else {
        callback(status);
      }
    };
    poses_are_ahead = true;
    WriteAlone(
        [&](Storage::Done done) {
          storage->ReviseBatches(key, std::move(plan->batches), next,
                                 std::move(done));
        },
        [this, next, answer](const absl::Status& status) {
          if (!status.ok()) {
            poses_are_ahead = false;
            answer(status);
          } else {
            Rebuild(config, next, answer);
          }
        });
  }

  void AddPosePair(
      PairKind kind, PosePairRecord pair,
      const std::function<
          void(absl::StatusOr<std::pair<PosePairRecord, std::uint64_t>>)>&
          callback) {
    const absl::Status writable = Writable();
    if (!writable.ok()) {
      callback(writable);
      return;
    }
    for (const std::uint64_t sequence :
         {pair.query_sequence, pair.matched_sequence}) {
      if (sequence < 1 || sequence > durable_sequence) {
        callback(PoseNotFound(id, sequence, durable_sequence));
        return;
      }
    }
    const auto existing = Pairs(kind).find(pair.id);
    if (existing != Pairs(kind).end()) {
      const PosePairRecord& there = existing->second;
      if (there.query_sequence == pair.query_sequence &&
          there.matched_sequence == pair.matched_sequence) {
        callback(std::make_pair(there, revision));
      } else {
        const PairWords words = WordsOf(kind);
        callback(Error(StatusCode::kAlreadyExists, words.exists,
                       std::string(words.noun) + " '" + pair.id +
                           "' names sequences " +
                           std::to_string(there.query_sequence) + " and " +
                           std::to_string(there.matched_sequence) + ", got " +
                           std::to_string(pair.query_sequence) + " and " +
                           std::to_string(pair.matched_sequence)));
      }
      return;
    }
    if (Pairs(kind).size() >= limits.max_pose_pairs) {
      callback(TooManyPairs(kind));
      return;
    }
    const bool is_last = !latest_pair_ns || *latest_pair_ns - kMostClockError <=
                                                pair.create_time_ns;
    if (is_last && latest_pair_ns) {
      pair.create_time_ns = std::max(pair.create_time_ns, *latest_pair_ns + 1);
    }
    const std::uint64_t next = revision + 1;
    WriteAlone(
        [&](Storage::Done done) {
          storage->AddPosePair(key, kind, pair, next, std::move(done));
        },
        [this, kind, pair, next, is_last,
         callback](const absl::Status& status) {
          if (!status.ok()) {
            callback(status);
            return;
          }
          Pairs(kind).emplace(pair.id, pair);
          if (is_last) {
            latest_pair_ns = pair.create_time_ns;
            Apply(engine.get(), kind, pair, next);
            NoteResidency();
            Settled(config, next);
            callback(std::make_pair(pair, next));
            return;
          }
          vehicle_is_ahead = true;
          Rebuild(config, next,
                  [pair, next, callback](const absl::Status& rebuilt) {
                    if (rebuilt.ok()) {
                      callback(std::make_pair(pair, next));
                    } else {
                      callback(rebuilt);
                    }
                  });
        });
  }

  absl::Status TooManyPairs(PairKind kind) const {
    const std::string limit = std::to_string(limits.max_pose_pairs);
    return Error(StatusCode::kFailedPrecondition, "POSE_PAIR_LIMIT",
                 "vehicle '" + id + "' has " + limit + " " +
                     WordsOf(kind).noun +
                     "s, which is the limit; delete some first",
                 {{"limit", limit}});
  }

  void FindLatestPair() {
    latest_pair_ns.reset();
    for (const PosePairs* of_kind : {&loop_closures, &rejections}) {
      for (const auto& [pair_id, pair] : *of_kind) {
        latest_pair_ns = std::max(latest_pair_ns.value_or(pair.create_time_ns),
                                  pair.create_time_ns);
      }
    }
  }

  void DeletePosePair(
      PairKind kind, const std::string& pair_id,
      const std::function<void(absl::StatusOr<std::uint64_t>)>& callback) {
    const absl::Status writable = Writable();
    if (!writable.ok()) {
      callback(writable);
      return;
    }
    const auto found = Pairs(kind).find(pair_id);
    if (found == Pairs(kind).end()) {
      const PairWords words = WordsOf(kind);
      callback(Error(
          StatusCode::kNotFound, words.not_found,
          "vehicle '" + id + "' has no " + words.noun + " '" + pair_id + "'"));
      return;
    }
    const std::uint64_t next = revision + 1;
    WriteAlone(
        [&](Storage::Done done) {
          storage->DeletePosePair(key, kind, pair_id, next, std::move(done));
        },
        [this, kind, pair = found->second, next,
         callback](const absl::Status& status) {
          if (!status.ok()) {
            callback(status);
            return;
          }
          TakeBack(kind, pair, next);
          NoteResidency();
          Pairs(kind).erase(pair.id);
          FindLatestPair();
          Settled(config, next);
          callback(next);
        });
  }

  void Delete(const std::function<void(absl::Status)>& callback) {
    vehicle_is_ahead = true;
    WriteAlone(
        [&](Storage::Done done) {
          storage->DeleteVehicle(key, std::move(done));
        },
        [this, callback](const absl::Status& status) {
          vehicle_is_ahead = false;
          if (status.ok() || absl::IsNotFound(status))
            Leave(VehicleNotFound(id));
          callback(status);
        });
  }
};

std::shared_ptr<VehicleSession> VehicleSession::Load(std::string id,
                                                     Storage* storage,
                                                     const RecordCodec* codec,
                                                     const Lanes& lanes,
                                                     const Limits& limits) {
  auto state =
      std::make_shared<State>(std::move(id), storage, codec, lanes, limits);
  state->strand->PostLong([state] { state->Load(); });
  return std::shared_ptr<VehicleSession>(new VehicleSession(std::move(state)));
}

VehicleSession::VehicleSession(std::shared_ptr<State> state)
    : state_(std::move(state)) {}

void VehicleSession::Read(
    std::function<void(absl::StatusOr<VehicleView>)> callback) {
  state_->Submit(state_->Reading(std::move(callback)));
}

void VehicleSession::LongRead(
    std::function<void(absl::StatusOr<VehicleView>)> callback) {
  state_->SubmitLong(state_->Reading(std::move(callback)));
}

void VehicleSession::ReadStored(
    std::function<void(absl::StatusOr<VehicleView>)> callback) {
  Operation reading = state_->Reading(std::move(callback));
  reading.reads_store = true;
  state_->SubmitLong(std::move(reading));
}

void VehicleSession::Search(
    std::function<void(absl::StatusOr<VehicleView>)> callback) {
  state_->SubmitSearch(state_->Reading(std::move(callback)));
}

void VehicleSession::Append(AppendRequest request) {
  State* const state = state_.get();
  if (state->pending_appends.fetch_add(1) >=
      state->limits.max_pending_appends) {
    state->pending_appends.fetch_sub(1);
    const absl::Status full =
        Error(StatusCode::kResourceExhausted, "QUEUE_FULL",
              "vehicle '" + state->id +
                  "': " + std::to_string(state->limits.max_pending_appends) +
                  " batches wait to be stored, which is the limit");
    state->strand->Post([callbacks = std::move(request.callbacks), full] {
      if (callbacks.staged) callbacks.staged(full);
      if (callbacks.durable) callbacks.durable(full);
    });
    return;
  }
  if (!request.should_stop) request.should_stop = [] { return false; };
  auto append = std::make_shared<PendingAppend>();
  append->request = std::move(request);
  state->SubmitAppend(std::move(append));
}

void VehicleSession::CheckAcknowledged(
    std::uint64_t acked_sequence, const std::string& vehicle_uid,
    std::function<void(absl::StatusOr<VehicleView>)> callback) {
  State* const state = state_.get();
  // Most often there is nothing to change, and nothing to wait for.
  state->Submit(
      {true, false,
       [state, acked_sequence, vehicle_uid,
        callback = std::move(callback)](const absl::Status& status) {
         if (!status.ok()) {
           callback(status);
           return;
         }
         if (!state->IsOfLostPoses(acked_sequence, vehicle_uid, callback)) {
           return;
         }
         state->Add({false, true,
                     [state, acked_sequence, vehicle_uid,
                      callback](const absl::Status& quiet) {
                       if (quiet.ok()) {
                         state->CheckAcknowledged(acked_sequence, vehicle_uid,
                                                  callback);
                       } else {
                         callback(quiet);
                       }
                     }});
       }});
}

void VehicleSession::Update(
    std::function<absl::StatusOr<VehicleConfig>(const VehicleView&)> change,
    std::function<void(absl::StatusOr<VehicleView>)> callback) {
  State* const state = state_.get();
  state->Submit({false, true,
                 [state, change = std::move(change),
                  callback = std::move(callback)](const absl::Status& status) {
                   if (status.ok()) {
                     state->Update(change, callback);
                   } else {
                     callback(status);
                   }
                 }});
}

void VehicleSession::AcceptDataLoss(
    std::uint64_t durable_sequence,
    std::function<void(absl::StatusOr<VehicleView>)> callback) {
  State* const state = state_.get();
  state->Submit({false, true,
                 [state, durable_sequence,
                  callback = std::move(callback)](const absl::Status& status) {
                   if (status.ok()) {
                     state->AcceptDataLoss(durable_sequence, callback);
                   } else {
                     callback(status);
                   }
                 }});
}

void VehicleSession::Revise(
    std::function<absl::StatusOr<RevisionPlan>(const VehicleView&)> plan,
    std::function<void(absl::StatusOr<std::pair<std::uint64_t, std::int64_t>>)>
        callback) {
  State* const state = state_.get();
  state->Submit({false, true,
                 [state, plan = std::move(plan),
                  callback = std::move(callback)](const absl::Status& status) {
                   if (status.ok()) {
                     state->Revise(plan, callback);
                   } else {
                     callback(status);
                   }
                 }});
}

void VehicleSession::AddPosePair(
    PairKind kind, PosePairRecord pair,
    std::function<
        void(absl::StatusOr<std::pair<PosePairRecord, std::uint64_t>>)>
        callback) {
  State* const state = state_.get();
  state->Submit({false, true,
                 [state, kind, pair = std::move(pair),
                  callback = std::move(callback)](const absl::Status& status) {
                   if (status.ok()) {
                     state->AddPosePair(kind, pair, callback);
                   } else {
                     callback(status);
                   }
                 }});
}

void VehicleSession::DeletePosePair(
    PairKind kind, std::string id,
    std::function<void(absl::StatusOr<std::uint64_t>)> callback) {
  State* const state = state_.get();
  state->Submit({false, true,
                 [state, kind, id = std::move(id),
                  callback = std::move(callback)](const absl::Status& status) {
                   if (status.ok()) {
                     state->DeletePosePair(kind, id, callback);
                   } else {
                     callback(status);
                   }
                 }});
}

void VehicleSession::Delete(std::function<void(absl::Status)> callback) {
  State* const state = state_.get();
  state->Submit(
      {false, true,
       [state, callback = std::move(callback)](const absl::Status& status) {
         if (status.ok()) {
           state->Delete(callback);
         } else {
           callback(status);
         }
       }});
}

void VehicleSession::LoadAnew() {
  State* const state = state_.get();
  state->Submit({false, true, [state](const absl::Status& status) {
                   if (status.ok() && state->damage.ok()) {
                     state->Leave(state->OutOfStep());
                   }
                 }});
}

void VehicleSession::GiveUpReplay() { state_->gives_up_replay = true; }

void VehicleSession::Close(std::function<void()> callback) {
  State* const state = state_.get();
  GiveUpReplay();
  state->Submit({false, true,
                 [state, callback = std::move(callback)](const absl::Status&) {
                   if (!state->gone_status) {
                     state->Leave(State::ShuttingDown());
                   }
                   callback();
                 }});
}

bool VehicleSession::gone() const { return state_->is_gone.load(); }

VehicleSession::Residency VehicleSession::residency() const {
  return {state_->resident_nodes.load(), state_->resident_bytes.load()};
}

bool VehicleSession::busy() const { return state_.use_count() > 1; }

}  // namespace revisit::server
