#include "server/sessions/vehicle_session.h"

#include <atomic>
#include <deque>

#include "server/sessions/appends.h"
#include "server/sessions/pose_dropper.h"
#include "server/sessions/replay.h"
#include "server/sessions/snapshots.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"
#include "server/storage/storage.h"

namespace revisit::server {

struct VehicleSession::State {
  State(std::string id, Storage* storage, const RecordCodec* codec,
        const Lanes& lanes, const Limits& limits, const SnapshotPolicy& policy,
        std::shared_ptr<RetentionMonitor> monitor, ServerClock clock,
        std::shared_ptr<VehicleCensus> census,
        const StoredChecksPolicy& checks_policy)
      : vehicle(std::move(id), storage, codec, policy, std::move(clock),
                std::move(census)),
        queue(&vehicle, &in_flight, lanes),
        appends(&vehicle, &queue, &in_flight, &dropper, &checks,
                limits.max_pending_appends),
        replayer(&vehicle, &queue),
        dropper(&vehicle, &queue, &replayer, std::move(monitor)),
        checks(&vehicle, &queue, &in_flight, checks_policy),
        changes(&vehicle, &queue, &replayer, &checks, limits.max_pose_pairs),
        snapshots(&vehicle, &queue) {}

  // Submits a change: `work(callback)` once it is its turn, or the callback
  // with the reason why not.
  template <typename Callback, typename Work>
  void SubmitAlone(Callback callback, Work work) {
    queue.Submit(
        {Turn::kAlone, [callback = std::move(callback),
                        work = std::move(work)](const absl::Status& status) {
           if (status.ok()) {
             work(callback);
           } else {
             callback(status);
           }
         }});
  }

  Operation Reading(Turn turn, ViewCallback callback) {
    return {turn,
            [this, callback = std::move(callback)](const absl::Status& status) {
              if (status.ok()) {
                callback(vehicle.View());
              } else {
                callback(status);
              }
            }};
  }

  struct SearchCall {
    std::string flow;
    SearchCallback callback;
  };

  void TakeSearchTurn(const SearchCall& search, const absl::Status& status) {
    const bool is_over =
        status.ok() ? search.callback(vehicle.View()) : search.callback(status);
    is_searching = !is_over || !searches.empty();
    if (!is_searching) return;
    SearchCall next = search;
    if (is_over) {
      next = std::move(searches.front());
      searches.pop_front();
    }
    queue.SubmitSearch({Turn::kSearch,
                        [this, next](const absl::Status& later) {
                          TakeSearchTurn(next, later);
                        },
                        next.flow});
  }

  // A callback of a change that stored checks may depend on.
  template <typename Answer>
  std::function<void(Answer)> Considering(
      std::function<void(Answer)> callback) {
    return [this, callback = std::move(callback)](Answer answer) {
      callback(std::move(answer));
      checks.Consider();
    };
  }

  // Runs `end` after what was called before, once the store knows whether
  // checks are owed, and no part of a snapshot is being written.
  template <typename End>
  void EndAfterSnapshots(Snapshots::Clock::time_point until, End end) {
    queue.Submit({Turn::kAlone, [this, until, end](const absl::Status&) {
                    if (checks.is_unsettled()) {
                      checks.Settle([this, until, end] {
                        EndAfterSnapshots(until, end);
                      });
                      return;
                    }
                    const bool may_write = (snapshots.is_due() &&
                                            Snapshots::Clock::now() < until) ||
                                           snapshots.has_new_marks();
                    if (!snapshots.is_writing() && !may_write) {
                      end();
                      return;
                    }
                    // Nothing may come in between.
                    queue.Hold();
                    snapshots.Stop(until, [this, end] { queue.Release(end); });
                  }});
  }

  // Begins what a vehicle that was loaded does by itself, once.
  void BeginWork() {
    checks.Consider();
    if (is_loaded.exchange(true)) return;
    dropper.ConsiderLoaded();
  }

  VehicleState vehicle;
  AppendsInFlight in_flight;
  VehicleQueue queue;
  Appends appends;
  Replayer replayer;
  PoseDropper dropper;
  StoredChecks checks;
  Changes changes;
  Snapshots snapshots;
  std::atomic<bool> is_loaded{false};
  // Whether a search is between two turns, and those that wait for its end.
  bool is_searching = false;
  std::deque<SearchCall> searches;
};

std::shared_ptr<VehicleSession> VehicleSession::Load(
    std::string id, Storage* storage, const RecordCodec* codec,
    const Lanes& lanes, const Limits& limits, const SnapshotPolicy& snapshots,
    std::shared_ptr<RetentionMonitor> retention, ServerClock clock,
    std::shared_ptr<VehicleCensus> census, const StoredChecksPolicy& checks) {
  auto state = std::make_shared<State>(
      std::move(id), storage, codec, lanes, limits, snapshots,
      std::move(retention), std::move(clock), std::move(census), checks);
  state->queue.KeepAlive(state);
  state->queue.PostLong([state = state.get()] { state->replayer.Load(); });
  state->queue.Submit(
      {Turn::kRead, [state = state.get()](const absl::Status& status) {
         if (status.ok()) state->BeginWork();
       }});
  return std::shared_ptr<VehicleSession>(new VehicleSession(std::move(state)));
}

VehicleSession::VehicleSession(std::shared_ptr<State> state)
    : state_(std::move(state)) {}

void VehicleSession::Read(ViewCallback callback) {
  state_->queue.Submit(state_->Reading(Turn::kRead, std::move(callback)));
}

void VehicleSession::LongRead(ViewCallback callback) {
  state_->queue.SubmitLong(state_->Reading(Turn::kRead, std::move(callback)));
}

void VehicleSession::ReadStored(ViewCallback callback) {
  state_->queue.SubmitLong(
      state_->Reading(Turn::kReadStored, std::move(callback)));
}

void VehicleSession::Search(std::string flow, SearchCallback callback) {
  State::SearchCall search{flow, std::move(callback)};
  state_->queue.SubmitSearch(
      {Turn::kSearch,
       [state = state_.get(),
        search = std::move(search)](const absl::Status& status) {
         if (state->is_searching) {
           state->searches.push_back(search);
         } else {
           state->TakeSearchTurn(search, status);
         }
       },
       std::move(flow)});
}

bool VehicleSession::is_wanted() const { return state_->queue.IsWanted(); }

void VehicleSession::Append(AppendRequest request,
                            std::shared_ptr<AppendObserver> observer) {
  state_->appends.Submit(std::move(request), std::move(observer));
}

void VehicleSession::CheckAcknowledged(std::uint64_t acked_sequence,
                                       const std::string& vehicle_uid,
                                       ViewCallback callback) {
  State* const state = state_.get();
  const auto check = [=](const ViewCallback& answer) {
    state->changes.CheckAcknowledged(acked_sequence, vehicle_uid, answer);
  };
  // Most often there is nothing to change, and nothing to wait for.
  state->queue.Submit(
      {Turn::kRead,
       [state, acked_sequence, vehicle_uid, check,
        callback = std::move(callback)](const absl::Status& status) {
         if (!status.ok()) {
           callback(status);
         } else if (!state->changes.AnswerUnlessLost(acked_sequence,
                                                     vehicle_uid, callback)) {
           state->SubmitAlone(callback, check);
         }
       }});
}

void VehicleSession::Update(ConfigChange change, ViewCallback callback) {
  State* const state = state_.get();
  // What the settings no longer keep goes after the answer.
  const auto answered = [state, callback = std::move(callback)](
                            const absl::StatusOr<VehicleView>& view) {
    callback(view);
    state->checks.Consider();
    state->dropper.Consider();
  };
  state->SubmitAlone<ViewCallback>(
      answered,
      [state, change = std::move(change)](const ViewCallback& answer) {
        state->changes.Update(change, answer);
      });
}

void VehicleSession::AcceptDataLoss(std::uint64_t durable_sequence,
                                    ViewCallback callback) {
  state_->SubmitAlone(
      std::move(callback),
      [state = state_.get(), durable_sequence](const ViewCallback& answer) {
        state->changes.AcceptDataLoss(
            durable_sequence,
            [state, answer](const absl::StatusOr<VehicleView>& view) {
              answer(view);
              state->checks.Consider();
            });
      });
}

void VehicleSession::Revise(RevisionPlanner plan, RevisionCallback callback) {
  state_->SubmitAlone(state_->Considering(std::move(callback)),
                      [state = state_.get(),
                       plan = std::move(plan)](const RevisionCallback& answer) {
                        state->changes.Revise(plan, answer);
                      });
}

void VehicleSession::AddPosePair(PairKind kind, PosePairRecord pair,
                                 PairAnswer answers, PairCallback callback) {
  state_->SubmitAlone(
      state_->Considering(std::move(callback)),
      [state = state_.get(), kind, pair = std::move(pair),
       answers = std::move(answers)](const PairCallback& answer) {
        state->changes.AddPosePair(kind, pair, answers, answer);
      });
}

void VehicleSession::PayChecks() {
  state_->queue.Submit(
      {Turn::kRead, [state = state_.get()](const absl::Status& status) {
         if (status.ok()) state->BeginWork();
       }});
}

void VehicleSession::GoOnWithChecks() {
  state_->queue.Submit(
      {Turn::kRead, [checks = &state_->checks](const absl::Status& status) {
         if (status.ok()) checks->GoOn();
       }});
}

bool VehicleSession::has_waiting_checks() const {
  return state_->checks.waits();
}

bool VehicleSession::has_unsettled_checks() const {
  return state_->checks.is_unsettled();
}

void VehicleSession::SettleChecks(std::function<void()> then) {
  state_->queue.Submit(
      {Turn::kAlone, [checks = &state_->checks,
                      then = std::move(then)](const absl::Status& status) {
         if (status.ok()) {
           checks->Settle(then);
         } else {
           then();
         }
       }});
}

std::int64_t VehicleSession::check_debt() const {
  return state_->checks.debt();
}

void VehicleSession::DeletePosePair(
    PairKind kind, std::string id, PairDeletion deletion,
    std::function<void(absl::StatusOr<std::uint64_t>)> callback) {
  state_->SubmitAlone(state_->Considering(std::move(callback)),
                      [state = state_.get(), kind, id = std::move(id),
                       deletion = std::move(deletion)](const auto& answer) {
                        state->changes.DeletePosePair(kind, id, deletion,
                                                      answer);
                      });
}

void VehicleSession::Delete(std::function<void(absl::Status)> callback) {
  state_->SubmitAlone(
      std::move(callback),
      [state = state_.get()](const std::function<void(absl::Status)>& answer) {
        state->changes.Delete(answer);
      });
}

void VehicleSession::LoadAnew() {
  state_->queue.Submit(
      {Turn::kAlone, [changes = &state_->changes](const absl::Status& status) {
         if (status.ok()) changes->LoadAnew();
       }});
}

void VehicleSession::GiveUpReplay() { state_->replayer.GiveUp(); }

void VehicleSession::HandOver() {
  state_->EndAfterSnapshots(
      Snapshots::Clock::now(), [vehicle = &state_->vehicle] {
        if (vehicle->gone_status()) return;
        vehicle->Leave(vehicle->HandedOver());
        vehicle->storage->ReleaseVehicle(vehicle->head.key());
      });
}

bool VehicleSession::wants_snapshot() const {
  return state_->snapshots.is_due();
}

bool VehicleSession::has_new_marks() const {
  return state_->snapshots.has_new_marks();
}

bool VehicleSession::is_writing_snapshot() const {
  return state_->snapshots.is_writing();
}

void VehicleSession::WriteSnapshot(int most_parts, std::function<void()> then) {
  state_->snapshots.Write(most_parts, std::move(then));
}

void VehicleSession::Close(std::chrono::steady_clock::time_point snapshot_until,
                           std::function<void()> callback) {
  GiveUpReplay();
  state_->EndAfterSnapshots(snapshot_until, [vehicle = &state_->vehicle,
                                             callback = std::move(callback)] {
    if (!vehicle->gone_status()) vehicle->Leave(ShuttingDown());
    callback();
  });
}

bool VehicleSession::is_loaded() const { return state_->is_loaded.load(); }

bool VehicleSession::gone() const { return state_->vehicle.is_gone(); }

VehicleSession::Residency VehicleSession::residency() const {
  return {state_->vehicle.loaded.resident_nodes(),
          state_->vehicle.loaded.resident_bytes()};
}

bool VehicleSession::busy() const { return state_.use_count() > 1; }

}  // namespace revisit::server
