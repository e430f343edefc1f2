// The vehicles of the store at work: their sessions, the threads these have,
// the room that callers get for them, and what is done to them from time to
// time.
#ifndef REVISIT_SERVER_VEHICLES_H_
#define REVISIT_SERVER_VEHICLES_H_

#include <memory>

#include "server/base/logging.h"
#include "server/base/periodic.h"
#include "server/connections/admission.h"
#include "server/conversion/stored_checks_codec.h"
#include "server/feed/event_feed.h"
#include "server/fleet/group_check_scopes.h"
#include "server/fleet/group_searches.h"
#include "server/groups/group_editor.h"
#include "server/records/proto_record_codec.h"
#include "server/sessions/executor.h"
#include "server/sessions/fair_executor.h"
#include "server/sessions/fleet.h"
#include "server/sessions/upkeep.h"
#include "server/sessions/vehicle_census.h"
#include "server/settings/settings.h"

namespace revisit::server {

class Storage;

class Vehicles {
 public:
  // `is_shared`: whether other servers may write to the storage too. Storage
  // and log must outlive this.
  Vehicles(const ServerSettings& settings, Storage* storage, bool is_shared,
           const Log* log);
  ~Vehicles() { check_scopes_.UseNone(); }

  Vehicles(const Vehicles&) = delete;
  Vehicles& operator=(const Vehicles&) = delete;

  Fleet* fleet() { return fleet_.get(); }
  const Fleet* fleet() const { return fleet_.get(); }
  const VehicleCensus* census() const { return census_.get(); }
  Admission* admission() { return &admission_; }
  const Admission* admission() const { return &admission_; }
  // For the vehicles' short work.
  Executor* executor() { return &executor_; }
  GroupSearches* group_searches() { return group_searches_.get(); }
  const GroupSearches* group_searches() const { return group_searches_.get(); }
  EventFeed* feed() { return &feed_; }
  const EventFeed* feed() const { return &feed_; }
  // For long reads of the store.
  Executor* read_executor() { return &read_executor_; }
  GroupEditor* groups() { return &groups_; }

 private:
  // The fleet needs those above it until its work is done.
  ProtoRecordCodec codec_;
  ProtoCheckCodec check_codec_;
  GroupCheckScopes check_scopes_;
  EventFeed feed_;
  Admission admission_;
  Executor executor_;
  Executor read_executor_;
  FairExecutor search_executor_;
  GroupEditor groups_;
  std::shared_ptr<VehicleCensus> census_;
  std::unique_ptr<Fleet> fleet_;
  std::unique_ptr<GroupSearches> group_searches_;
  std::unique_ptr<Upkeep> upkeep_;
  std::unique_ptr<Periodic> group_upkeep_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_VEHICLES_H_
