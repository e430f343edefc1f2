#include "server/sessions/changes.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "core/drive/measured_loop.h"
#include "core/drive/pose_graph.h"
#include "core/settings.h"
#include "server/sessions/drive_replay.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Above so many nodes, or loop closures, a change that looks at each of them
// takes longer than other vehicles' short work is to wait: 10 ms or so.
constexpr core::NodeIndex kManyNodes = 20'000;
constexpr std::size_t kManyClosures = 500;

// Answers with the value, or with the status where that is not OK.
template <typename Value>
std::function<void(const absl::Status&)> Answering(
    std::function<void(absl::StatusOr<Value>)> callback, Value value) {
  return [callback = std::move(callback),
          value = std::move(value)](const absl::Status& status) {
    if (status.ok()) {
      callback(value);
    } else {
      callback(status);
    }
  };
}

// Whether other nodes are to be kept, so that all have to be looked at again.
bool KeepsOthers(const core::DriveSettings& before,
                 const core::DriveSettings& after) {
  return (core::RemadeBetween(before, after) & core::kRemadeKept) != 0;
}

}  // namespace

using absl::StatusCode;
using absl::StrCat;

void Changes::Write(const StorageWrite& write, Then then) {
  queue_->Hold();
  write(queue_->OnStrand(
      [this, then = std::move(then)](const absl::Status& status) {
        if (!status.ok()) vehicle_->NoteFailedWrite(status);
        queue_->Release([&] { then(status); });
      }));
}

void Changes::Confirm(Then then) {
  Write(
      [&](Storage::Done done) {
        vehicle_->storage->ConfirmOwned(vehicle_->head.key(), std::move(done));
      },
      std::move(then));
}

void Changes::WriteForLongWork(const StorageWrite& write,
                               VehicleQueue::StoreLead lead, Then then) {
  queue_->Hold();
  write(queue_->OnStrand(
      [this, lead, then = std::move(then)](const absl::Status& status) {
        if (!status.ok()) {
          vehicle_->NoteFailedWrite(status);
          queue_->Release([&] { then(status); });
          return;
        }
        queue_->set_store_lead(lead);
        queue_->PostLong([this, then] {
          queue_->set_store_lead(VehicleQueue::StoreLead::kNone);
          queue_->Release([&] { then(absl::OkStatus()); });
        });
      }));
}

Changes::StorageWrite Changes::WriteOf(const VehicleConfig& config) const {
  return [this, &config](Storage::Done done) {
    vehicle_->storage->UpdateVehicle(
        vehicle_->head.key(), vehicle_->codec->EncodeVehicle(config),
        vehicle_->head.revision() + 1, std::move(done));
  };
}

absl::Status Changes::Apply(const VehicleConfig& config,
                            std::uint64_t revision) {
  const bool keeps_others =
      KeepsOthers(vehicle_->head.config().drive, config.drive);
  absl::Status changed;
  vehicle_->loaded.Change([&](core::Drive* drive) {
    changed = drive->ChangeSettings(config.drive, revision);
  });
  if (!changed.ok()) return changed;
  vehicle_->head.Adopt(config, revision);
  if (keeps_others) vehicle_->loaded.LookAtOnce();
  return absl::OkStatus();
}

void Changes::ChangeConfig(const VehicleConfig& config, Then then) {
  const auto change = [this, config, next = vehicle_->head.revision() + 1,
                       then = std::move(then)](const absl::Status& status) {
    then(status.ok() ? Apply(config, next) : status);
  };
  if (vehicle_->loaded->graph().size() < kManyNodes &&
      vehicle_->pairs.loop_closures().size() < kManyClosures) {
    Write(WriteOf(config), change);
  } else {
    // Readers see the settings as they were until the change is done.
    WriteForLongWork(WriteOf(config), VehicleQueue::StoreLead::kNone, change);
  }
}

Changes::Then Changes::AnswerWithView(const ViewCallback& callback) {
  return [this, callback](const absl::Status& status) {
    if (status.ok()) {
      callback(vehicle_->View());
    } else {
      callback(status);
    }
  };
}

bool Changes::AnswerUnlessLost(std::uint64_t acked_sequence,
                               const std::string& vehicle_uid,
                               const ViewCallback& callback) const {
  const absl::Status meant =
      vehicle_->head.config_is_known()
          ? CheckMeant(vehicle_->id, vehicle_->head.config(), vehicle_uid)
          : vehicle_->head.damage();
  if (!meant.ok()) {
    callback(meant);
  } else if (!vehicle_->head.damage().ok()) {
    callback(vehicle_->head.damage());
  } else if (acked_sequence > vehicle_->head.durable_sequence()) {
    return false;
  } else {
    callback(vehicle_->View());
  }
  return true;
}

void Changes::CheckAcknowledged(std::uint64_t acked_sequence,
                                const std::string& vehicle_uid,
                                const ViewCallback& callback) {
  if (AnswerUnlessLost(acked_sequence, vehicle_uid, callback)) return;
  const ErrorMetadata acked = {{"acked_sequence", StrCat(acked_sequence)}};
  const absl::Status loss = vehicle_->DataLoss(acked);
  if (vehicle_->head.config().data_loss) {
    callback(loss);
    return;
  }
  if (vehicle_uid.empty()) {
    callback(vehicle_->Regressed(
        StrCat("the client holds an acknowledgement for sequence ",
               acked_sequence, ", but only ", vehicle_->head.durable_sequence(),
               " poses are stored; no vehicle_uid was sent, so only this "
               "stream ends"),
        acked));
    return;
  }
  VehicleConfig config = vehicle_->head.config();
  config.data_loss = true;
  ChangeConfig(config, [this, callback, loss](const absl::Status& written) {
    // The vehicle is another server's, and what that one has is what counts.
    if (absl::IsAborted(written)) {
      callback(written);
      return;
    }
    // Holds in memory even if it could not be stored; the client will say so
    // again. Not before: nobody may see what a crash could take back.
    vehicle_->head.LoseData();
    vehicle_->Report();
    callback(loss);
  });
}

void Changes::AcceptDataLoss(std::uint64_t durable_sequence,
                             const ViewCallback& callback) {
  const ErrorMetadata metadata = {
      {"durable_sequence", StrCat(vehicle_->head.durable_sequence())}};
  if (!vehicle_->head.config_is_known()) {
    callback(vehicle_->head.damage());
    return;
  }
  if (!vehicle_->head.config().data_loss && vehicle_->head.damage().ok()) {
    callback(Error(StatusCode::kFailedPrecondition, "NO_DATA_LOSS",
                   StrCat("vehicle '", vehicle_->id,
                          "' is neither in the state DATA_LOSS nor DAMAGED"),
                   metadata));
    return;
  }
  if (durable_sequence != vehicle_->head.durable_sequence()) {
    callback(
        Error(StatusCode::kFailedPrecondition, "DURABLE_SEQUENCE_MISMATCH",
              StrCat("durable_sequence: got ", durable_sequence,
                     ", the vehicle's is ", vehicle_->head.durable_sequence()),
              metadata));
    return;
  }
  VehicleConfig config = vehicle_->head.config();
  config.data_loss = false;
  config.damaged = false;
  const Then answer = [this, callback](const absl::Status& status) {
    vehicle_->Report();
    AnswerWithView(callback)(status);
  };
  if (vehicle_->head.damage().ok()) {
    ChangeConfig(config, answer);
  } else {
    DropDamaged(config, answer);
  }
}

void Changes::DropDamaged(const VehicleConfig& config, Then then) {
  const std::uint64_t next = vehicle_->head.revision() + 1;
  Write(
      [&](Storage::Done done) {
        vehicle_->storage->DropDamaged(
            vehicle_->head.key(), vehicle_->head.durable_sequence(),
            vehicle_->codec->EncodeVehicle(config), next, std::move(done));
      },
      [this, config, next, then = std::move(then)](const absl::Status& status) {
        if (status.ok()) {
          vehicle_->head.AcceptDamage();
          ChecksHead checks = vehicle_->head.checks();
          checks.checked_sequence = std::min(checks.checked_sequence,
                                             vehicle_->head.durable_sequence());
          vehicle_->head.set_checks(checks);
          // That head may have been damaged too: the next write looks.
          vehicle_->Doubt();
        }
        then(status.ok() ? Apply(config, next) : status);
      });
}

void Changes::Update(const ConfigChange& change, const ViewCallback& callback) {
  if (absl::Status status = vehicle_->Writable(); !status.ok()) {
    callback(status);
    return;
  }
  const absl::StatusOr<VehicleConfig> config = change(vehicle_->View());
  if (!config.ok()) {
    callback(config.status());
    return;
  }
  const Then answer = AnswerWithView(callback);
  if (!core::MovesNodes(vehicle_->head.config().drive, config->drive)) {
    ChangeConfig(*config, answer);
    return;
  }
  const bool keeps_others =
      KeepsOthers(vehicle_->head.config().drive, config->drive);
  Write(WriteOf(*config), [this, config = *config,
                           next = vehicle_->head.revision() + 1, keeps_others,
                           answer](const absl::Status& status) {
    if (!status.ok()) {
      answer(status);
      return;
    }
    replayer_->Rebuild(config, next,
                       [this, keeps_others, answer](const absl::Status& done) {
                         if (keeps_others) vehicle_->loaded.LookAtOnce();
                         answer(done);
                       });
  });
}

void Changes::Revise(const RevisionPlanner& plan,
                     const RevisionCallback& callback) {
  if (absl::Status status = vehicle_->Writable(); !status.ok()) {
    callback(status);
    return;
  }
  // The plan reads all that it revises.
  queue_->Hold();
  queue_->PostLong([this, plan, callback] {
    queue_->Release([&] { WriteRevision(plan, callback); });
  });
}

void Changes::WriteRevision(const RevisionPlanner& make_plan,
                            const RevisionCallback& callback) {
  absl::StatusOr<RevisionPlan> plan = make_plan(vehicle_->View());
  if (!plan.ok()) {
    callback(plan.status());
    return;
  }
  if (plan->done_by) {
    callback(RevisionResult{*plan->done_by, plan->revised_count,
                            plan->dropped_count});
    return;
  }
  if (!plan->batches) {
    callback(RevisionResult{vehicle_->head.revision(), 0, plan->dropped_count});
    return;
  }
  WriteRevised(std::move(plan->batches),
               {vehicle_->head.revision() + 1, plan->revised_count,
                plan->dropped_count, /*is_new=*/true},
               callback);
}

void Changes::WriteRevised(BatchSource batches, const RevisionResult& result,
                           const RevisionCallback& callback) {
  queue_->set_store_lead(VehicleQueue::StoreLead::kPoses);
  Write(
      [&](Storage::Done done) {
        vehicle_->storage->ReviseBatches(vehicle_->head.key(),
                                         std::move(batches), result.revision,
                                         std::move(done));
      },
      [this, result, callback](const absl::Status& status) {
        if (status.ok()) {
          replayer_->Rebuild(vehicle_->head.config(), result.revision,
                             Answering(callback, result));
        } else {
          queue_->set_store_lead(VehicleQueue::StoreLead::kNone);
          callback(status);
        }
      });
}

void Changes::AddPosePair(PairKind kind, PosePairRecord pair,
                          const PairAnswer& answers,
                          const PairCallback& callback) {
  const PosePairs& pairs = vehicle_->pairs.Of(kind);
  const auto found = pairs.find(pair.id);
  absl::Status allowed = vehicle_->Writable();
  if (allowed.ok()) {
    allowed = CheckNewPair(kind, pair,
                           found == pairs.end() ? nullptr : &found->second);
  }
  const auto measured = std::make_shared<MeasuredLoops>();
  if (allowed.ok()) {
    allowed = measured->Add(*vehicle_,
                            vehicle_->head.config().drive.state_space, pair);
  }
  if (!allowed.ok()) {
    callback(allowed);
    return;
  }
  // One that is there already decides anew only what the caller names.
  const bool is_there = found != pairs.end();
  const bool asks_checks =
      (!is_there || answers.candidate) && checks_->HasCandidates();
  if (measured->empty() && !asks_checks && !answers.candidate) {
    StorePair(kind, std::move(pair), nullptr, std::nullopt, callback);
    return;
  }
  queue_->Hold();
  queue_->PostLong([this, kind, pair = std::move(pair), measured, is_there,
                    asks_checks, answers, callback]() mutable {
    absl::Status read;
    if (!measured->empty()) {
      read = measured
                 ->ReadPoses(
                     *vehicle_, vehicle_->head.key(), vehicle_->head.config(),
                     vehicle_->head.durable_sequence(), [] { return true; })
                 .status();
    }
    // Its time goes with what it decides.
    if (asks_checks && !is_there) PlaceInOrder(&pair);
    absl::StatusOr<std::optional<ChecksWrite>> checks =
        std::optional<ChecksWrite>();
    if (read.ok() && asks_checks) {
      checks = checks_->WithPair(kind, pair, is_there, answers.candidate,
                                 answers.actor);
    } else if (read.ok() && answers.candidate && !checks_->HasCandidates()) {
      checks = StoredChecks::CheckNotFound(vehicle_->id, *answers.candidate);
    }
    queue_->Release([&] {
      if (!checks.ok()) {
        callback(checks.status());
        return;
      }
      if (read.ok()) {
        StorePair(kind, pair,
                  measured->empty() ? nullptr : measured->Find(pair), *checks,
                  callback);
        return;
      }
      callback(read);
      if (absl::IsDataLoss(read)) LoadAnew();
    });
  });
}

void Changes::StorePair(
    PairKind kind, PosePairRecord pair,
    const std::shared_ptr<const core::MeasuredLoop>& measured,
    const std::optional<ChecksWrite>& checks, const PairCallback& callback) {
  AddedPair added;
  if (measured) {
    added.agreement = vehicle_->loaded->AgreementOf(
        pair.query_sequence, pair.matched_sequence, measured);
  }
  const auto present = vehicle_->pairs.Of(kind).find(pair.id);
  if (present != vehicle_->pairs.Of(kind).end()) {
    added.pair = present->second;
    added.revision = vehicle_->head.revision();
    if (!checks) {
      Confirm(Answering(callback, added));
      return;
    }
    Write(
        [&](Storage::Done done) {
          vehicle_->storage->PutChecks(vehicle_->head.key(), *checks,
                                       std::move(done));
        },
        [this, added, head = checks->after,
         callback](const absl::Status& status) {
          if (!status.ok()) {
            callback(FailureOf(status));
            return;
          }
          vehicle_->head.set_checks(head);
          callback(added);
        });
    return;
  }
  const bool is_last = PlaceInOrder(&pair);
  added.pair = std::move(pair);
  added.revision = vehicle_->head.revision() + 1;
  added.is_new = true;
  WritePair(kind, added, is_last, measured, checks, callback);
}

void Changes::WritePair(
    PairKind kind, const AddedPair& added, bool is_last,
    const std::shared_ptr<const core::MeasuredLoop>& measured,
    const std::optional<ChecksWrite>& checks, const PairCallback& callback) {
  const ChecksHead head = checks ? checks->after : vehicle_->head.checks();
  Write(
      [&](Storage::Done done) {
        vehicle_->storage->AddPosePair(vehicle_->head.key(), kind, added.pair,
                                       checks, added.revision, std::move(done));
      },
      [this, kind, added, is_last, measured, head,
       callback](const absl::Status& status) {
        if (!status.ok()) {
          callback(FailureOf(status));
          return;
        }
        vehicle_->head.set_checks(head);
        vehicle_->pairs.Add(kind, added.pair);
        if (is_last) {
          TakeOnLastPair(kind, added.pair, added.revision, measured);
          callback(added);
          return;
        }
        queue_->set_store_lead(VehicleQueue::StoreLead::kVehicle);
        replayer_->Rebuild(vehicle_->head.config(), added.revision,
                           Answering(callback, added));
      });
}

absl::Status Changes::FailureOf(const absl::Status& status) {
  if (!absl::IsFailedPrecondition(status)) return status;
  // The store has lost its last writes, which were of checks.
  vehicle_->Leave(vehicle_->OutOfStep());
  return *vehicle_->gone_status();
}

absl::Status Changes::CheckNewPair(PairKind kind, const PosePairRecord& pair,
                                   const PosePairRecord* present) const {
  for (const std::uint64_t sequence :
       {pair.query_sequence, pair.matched_sequence}) {
    if (sequence < 1 || sequence > vehicle_->head.durable_sequence()) {
      return PoseNotFound(vehicle_->id, sequence,
                          vehicle_->head.durable_sequence());
    }
    // What is there already may have outlived a pose of it.
    if (present == nullptr) {
      const absl::Status kept = CheckKept(vehicle_->View(), sequence);
      if (!kept.ok()) return kept;
    }
  }
  const PairWords words = WordsOf(kind);
  if (present != nullptr) {
    if (present->query_sequence == pair.query_sequence &&
        present->matched_sequence == pair.matched_sequence) {
      if (vehicle_->codec->SayTheSame(present->payload, pair.payload)) {
        return absl::OkStatus();
      }
      return Error(StatusCode::kAlreadyExists, words.exists,
                   StrCat(words.noun, " '", pair.id, "' has another ",
                          words.content, "; to replace it, delete it first"));
    }
    return Error(
        StatusCode::kAlreadyExists, words.exists,
        StrCat(words.noun, " '", pair.id, "' names sequences ",
               present->query_sequence, " and ", present->matched_sequence,
               ", got ", pair.query_sequence, " and ", pair.matched_sequence));
  }
  if (vehicle_->pairs.Of(kind).size() >= max_pose_pairs_) {
    const std::string limit = StrCat(max_pose_pairs_);
    return Error(StatusCode::kFailedPrecondition, "POSE_PAIR_LIMIT",
                 StrCat("vehicle '", vehicle_->id, "' has ", limit, " ",
                        words.noun, "s, which is the limit; delete some first"),
                 {{"limit", limit}});
  }
  return CheckConflict(kind, pair);
}

absl::Status Changes::CheckConflict(PairKind kind,
                                    const PosePairRecord& pair) const {
  const PairKind other = kind == PairKind::kLoopClosure
                             ? PairKind::kRejectedCandidate
                             : PairKind::kLoopClosure;
  const PosePairs& others = vehicle_->pairs.Of(other);
  const auto found =
      std::find_if(others.begin(), others.end(), [&](const auto& entry) {
        return entry.second.query_sequence == pair.query_sequence &&
               entry.second.matched_sequence == pair.matched_sequence;
      });
  if (found == others.end()) return absl::OkStatus();
  const PairWords words = WordsOf(other);
  const std::string name = StrCat("vehicles/", vehicle_->id, "/",
                                  words.collection, "/", found->first);
  return Error(
      StatusCode::kFailedPrecondition, "POSE_PAIR_CONFLICT",
      StrCat("sequences ", pair.query_sequence, " and ", pair.matched_sequence,
             " are the ", words.noun, " '", found->first, "' and cannot be a ",
             WordsOf(kind).noun, " too; delete that first if it was a mistake"),
      {{"name", name}});
}

bool Changes::PlaceInOrder(PosePairRecord* pair) const {
  const std::optional<std::int64_t>& latest = vehicle_->pairs.latest_ns();
  if (!latest) return true;
  if (*latest - kMostClockError > pair->create_time_ns) return false;
  pair->create_time_ns = std::max(pair->create_time_ns, *latest + 1);
  return true;
}

void Changes::TakeOnLastPair(
    PairKind kind, const PosePairRecord& pair, std::uint64_t revision,
    const std::shared_ptr<const core::MeasuredLoop>& measured) {
  vehicle_->loaded.Change([&](core::Drive* drive) {
    AddPair(drive, kind, pair, revision, measured);
  });
  vehicle_->head.Adopt(revision);
}

void Changes::DeletePosePair(
    PairKind kind, const std::string& id, const PairDeletion& deletion,
    const std::function<void(absl::StatusOr<std::uint64_t>)>& callback) {
  if (absl::Status status = vehicle_->Writable(); !status.ok()) {
    callback(status);
    return;
  }
  const auto found = vehicle_->pairs.Of(kind).find(id);
  if (found == vehicle_->pairs.Of(kind).end()) {
    ConfirmMissing(kind, id, callback);
    return;
  }
  if (!checks_->HasCandidates()) {
    RemovePair(kind, found->second, deletion, std::nullopt, callback);
    return;
  }
  queue_->Hold();
  queue_->PostLong([this, kind, pair = found->second, deletion, callback] {
    const auto checks =
        checks_->WithoutPair(kind, pair, deletion.deleted_by, deletion.time_ns);
    queue_->Release([&] {
      if (checks.ok()) {
        RemovePair(kind, pair, deletion, *checks, callback);
      } else {
        callback(checks.status());
      }
    });
  });
}

void Changes::RemovePair(
    PairKind kind, const PosePairRecord& pair, const PairDeletion& deletion,
    const std::optional<ChecksWrite>& checks,
    const std::function<void(absl::StatusOr<std::uint64_t>)>& callback) {
  const std::uint64_t next = vehicle_->head.revision() + 1;
  const ChecksHead head = checks ? checks->after : vehicle_->head.checks();
  const auto write = [&](Storage::Done done) {
    DeletedPairRecord deleted;
    deleted.kind = kind;
    deleted.pair = pair;
    deleted.pair.payload =
        vehicle_->codec->WithDeleter(pair.payload, deletion.deleted_by);
    deleted.delete_time_ns = deletion.time_ns;
    vehicle_->storage->DeletePosePair(vehicle_->head.key(), std::move(deleted),
                                      checks, next, std::move(done));
  };
  const auto take_back = [this, kind, pair, next, head,
                          callback](const absl::Status& status) {
    if (!status.ok()) {
      callback(FailureOf(status));
      return;
    }
    vehicle_->head.set_checks(head);
    TakeBack(kind, pair, next);
    vehicle_->pairs.Remove(kind, {pair.id});
    vehicle_->head.Adopt(next);
    callback(next);
  };
  if (vehicle_->pairs.loop_closures().size() < kManyClosures) {
    Write(write, take_back);
  } else {
    WriteForLongWork(write, VehicleQueue::StoreLead::kVehicle, take_back);
  }
}

void Changes::ConfirmMissing(
    PairKind kind, const std::string& id,
    const std::function<void(absl::StatusOr<std::uint64_t>)>& callback) {
  const PairWords words = WordsOf(kind);
  const absl::Status missing =
      Error(StatusCode::kNotFound, words.not_found,
            StrCat("vehicle '", vehicle_->id, "' has no ", words.noun, " '", id,
                   "'"));
  Confirm([callback, missing](const absl::Status& status) {
    callback(status.ok() ? missing : status);
  });
}

void Changes::TakeBack(PairKind kind, const PosePairRecord& pair,
                       std::uint64_t revision) {
  if (kind == PairKind::kRejectedCandidate) {
    vehicle_->loaded.Change([&](core::Drive* drive) {
      drive->RemoveRejection(pair.query_sequence, pair.matched_sequence,
                             revision);
    });
    return;
  }
  // The same poses may be named more than once, and what the others teach
  // depends on their order.
  std::size_t occurrence = 0;
  for (const auto& [other_kind, other] : vehicle_->pairs.AsAdded()) {
    if (other_kind != kind) continue;
    if (other->id == pair.id) break;
    if (other->query_sequence == pair.query_sequence &&
        other->matched_sequence == pair.matched_sequence) {
      ++occurrence;
    }
  }
  vehicle_->loaded.Change([&](core::Drive* drive) {
    drive->RemoveLoopClosure(pair.query_sequence, pair.matched_sequence,
                             revision, occurrence);
  });
}

void Changes::LoadAnew() {
  if (!vehicle_->head.damage().ok()) return;
  queue_->set_store_lead(VehicleQueue::StoreLead::kVehicle);
  Write(
      [&](Storage::Done done) {
        vehicle_->storage->DropSnapshot(vehicle_->head.key(), std::move(done));
      },
      [this](const absl::Status&) {
        queue_->set_store_lead(VehicleQueue::StoreLead::kNone);
        if (!vehicle_->gone_status()) vehicle_->Leave(vehicle_->OutOfStep());
      });
}

void Changes::Delete(const std::function<void(absl::Status)>& callback) {
  queue_->set_store_lead(VehicleQueue::StoreLead::kVehicle);
  Write(
      [&](Storage::Done done) {
        vehicle_->storage->DeleteVehicle(vehicle_->head.key(),
                                         checks_->Farewell(), std::move(done));
      },
      [this, callback](const absl::Status& status) {
        queue_->set_store_lead(VehicleQueue::StoreLead::kNone);
        if (status.ok() && vehicle_->census != nullptr) {
          vehicle_->census->Deleted(vehicle_->head.key());
        }
        if (status.ok() || absl::IsNotFound(status)) {
          vehicle_->Leave(VehicleNotFound(vehicle_->id));
        }
        callback(status);
      });
}

}  // namespace revisit::server
