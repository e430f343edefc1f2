#include "server/storage/postgres/postgres_appends.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <map>
#include <set>

#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

// Parameters, for each run: $1 key, $2 owner, $3 epoch, $4 first and $5 last
// sequence, $6 revision, and $7 and $8 the numbers of its first and last row.
// Each row brings: $9 first sequence, $10 count, $11 revision, $12 checksum,
// and $13 and $14 where its payload begins in $15 and how long it is. $16 is
// the format, $17 each run's revision of before.
//
// Rows are reached by their number, because a join of them with the updated
// heads takes thrice the time, and payloads lie in one value, because an array
// of them is walked from its start for each. An update takes one row of its
// source for each of its own, hence one run per vehicle.
constexpr Statement kAppend = {
    "append",
    "WITH h AS (UPDATE heads v SET durable_sequence = a.l, "
    "revision = greatest(v.revision, a.rev) FROM unnest($1::int8[], "
    "$2::uuid[], $3::int8[], $4::int8[], $5::int8[], $6::int8[], $7::int8[], "
    "$8::int8[], $17::int8[]) AS a(k, o, e, f, l, rev, first_row, last_row, "
    "was) WHERE v.key = a.k AND v.owner = a.o AND v.epoch = a.e AND "
    "v.revision = a.was AND v.durable_sequence = a.f - 1 "
    "RETURNING a.k, a.first_row, a.last_row), "
    "b AS (INSERT INTO batches (vehicle_key, first_sequence, count, format, "
    "revision, checksum, payload) SELECT h.k, ($9::int8[])[i], "
    "($10::int8[])[i], $16::int8, ($11::int8[])[i], ($12::int8[])[i], "
    "substring($15::bytea FROM (($13::int8[])[i])::int4 FOR "
    "(($14::int8[])[i])::int4) FROM h, "
    "generate_series(h.first_row, h.last_row) i) SELECT k FROM h"};

// $11 first and $12 last sequence. Of each row: $13 first sequence, $14 count,
// $15 revision, $16 checksum, $17 payload.
constexpr Statement kAppendWithVehicle = {
    "append_with_vehicle",
    REVISIT_FENCE(", durable_sequence = $12::int8",
                  REVISIT_UNCHANGED " AND durable_sequence = $11::int8 - 1")
    ", b AS (INSERT INTO batches (vehicle_key, first_sequence, count, format, "
    "revision, checksum, payload) SELECT h.key, a.f, a.n, $7::int8, a.rev, "
    "a.ck, a.p FROM h, unnest($13::int8[], $14::int8[], $15::int8[], "
    "$16::int8[], $17::bytea[]) AS a(f, n, rev, ck, p)) "
    REVISIT_REPLACE_VEHICLE};

// The columns of rows but their payloads.
struct RowColumns {
  std::vector<std::int64_t> firsts;
  std::vector<std::int64_t> counts;
  std::vector<std::int64_t> revisions;
  std::vector<std::int64_t> checksums;

  void Add(VehicleKey key, const BatchRecord& row) {
    firsts.push_back(Signed(row.first_sequence));
    counts.push_back(row.count);
    revisions.push_back(Signed(row.revision));
    checksums.push_back(
        ChecksumOfBatch(kSharedRowFormat, key, BatchVersion::kAsSent, row));
  }
};

// Why a vehicle's append wrote nothing.
absl::Status WhyNotAppended(const std::map<VehicleKey, Head>& heads,
                            const Fence& fence, std::uint64_t first_sequence) {
  const auto head = heads.find(fence.key);
  if (head == heads.end()) return GoneVehicle(fence);
  const Claim* const claim = fence.claim.get();
  if (!Holds(claim, head->second) ||
      head->second.durable_sequence + 1 == first_sequence) {
    return Fenced(claim == nullptr
                      ? "the vehicle of key " + std::to_string(fence.key)
                      : "vehicle '" + claim->vehicle_id + "'");
  }
  return SequenceGap(claim->vehicle_id, head->second.durable_sequence + 1,
                     first_sequence);
}

}  // namespace

absl::Status AppendRuns(PostgresConnection& connection,
                        const std::vector<AppendRun>& runs,
                        std::vector<absl::Status>* results) {
  std::vector<std::int64_t> keys;
  std::vector<Uuid> owners;
  std::vector<std::int64_t> epochs;
  std::vector<std::int64_t> run_firsts;
  std::vector<std::int64_t> run_lasts;
  std::vector<std::int64_t> run_revisions;
  std::vector<std::int64_t> revisions_before;
  std::vector<std::int64_t> first_rows;
  std::vector<std::int64_t> last_rows;
  RowColumns rows;
  std::vector<std::int64_t> starts;
  std::vector<std::int64_t> lengths;
  std::string payloads;
  for (const AppendRun& run : runs) {
    const Claim& claim = Compared(run.front()->claim.get());
    keys.push_back(run.front()->key);
    owners.push_back(claim.owner);
    epochs.push_back(claim.epoch);
    run_firsts.push_back(Signed(run.front()->first_sequence()));
    run_lasts.push_back(Signed(run.back()->last_sequence()));
    revisions_before.push_back(Signed(claim.revision));
    // SQL counts from 1.
    first_rows.push_back(static_cast<std::int64_t>(rows.firsts.size()) + 1);
    std::uint64_t highest = 0;
    for (const PendingWrite* append : run) {
      for (const BatchRecord& row : append->rows) {
        highest = std::max(highest, row.revision);
        rows.Add(append->key, row);
        starts.push_back(static_cast<std::int64_t>(payloads.size()) + 1);
        lengths.push_back(static_cast<std::int64_t>(row.payload.size()));
        payloads += row.payload;
      }
    }
    run_revisions.push_back(Signed(highest));
    last_rows.push_back(static_cast<std::int64_t>(rows.firsts.size()));
  }
  const auto answer = connection.Run(kAppend, Parameters()
                                                  .Add(keys)
                                                  .Add(owners)
                                                  .Add(epochs)
                                                  .Add(run_firsts)
                                                  .Add(run_lasts)
                                                  .Add(run_revisions)
                                                  .Add(first_rows)
                                                  .Add(last_rows)
                                                  .Add(rows.firsts)
                                                  .Add(rows.counts)
                                                  .Add(rows.revisions)
                                                  .Add(rows.checksums)
                                                  .Add(starts)
                                                  .Add(lengths)
                                                  .AddText(payloads)
                                                  .Add(kSharedRowFormat)
                                                  .Add(revisions_before));
  if (!answer.ok()) return answer.status();
  std::set<VehicleKey> written;
  for (int i = 0; i < answer->size(); ++i) {
    written.insert(answer->Integer(i, 0));
  }
  std::vector<std::int64_t> missing;
  for (std::size_t i = 0; i < runs.size(); ++i) {
    const PendingWrite& first = *runs[i].front();
    if (written.count(first.key) == 0) {
      missing.push_back(first.key);
    } else {
      NoteWritten({first.key, first.claim}, Unsigned(run_revisions[i]));
    }
  }
  results->assign(runs.size(), absl::OkStatus());
  if (missing.empty()) return absl::OkStatus();
  const auto heads = ReadHeads(connection, missing);
  for (std::size_t i = 0; i < runs.size(); ++i) {
    const PendingWrite& first = *runs[i].front();
    if (written.count(first.key) > 0) continue;
    (*results)[i] = heads.ok()
                        ? WhyNotAppended(*heads, {first.key, first.claim},
                                         first.first_sequence())
                        : heads.status();
  }
  return absl::OkStatus();
}

absl::Status AppendWithVehicle(PostgresConnection& connection,
                               const Fence& fence,
                               const std::vector<BatchRecord>& batches,
                               const std::string& vehicle_payload) {
  auto vehicle = ReadVehicleRow(connection, fence);
  if (!vehicle.ok()) return vehicle.status();
  const std::uint64_t first = batches.front().first_sequence;
  const std::uint64_t last =
      batches.back().first_sequence + batches.back().count - 1;
  RowColumns rows;
  std::vector<const std::string*> payloads;
  for (const BatchRecord& batch : batches) {
    rows.Add(fence.key, batch);
    payloads.push_back(&batch.payload);
  }
  const auto answer = connection.Run(
      kAppendWithVehicle, Replacing(fence, *std::move(vehicle), vehicle_payload,
                                    batches.back().revision)
                              .Add(Signed(first))
                              .Add(Signed(last))
                              .Add(rows.firsts)
                              .Add(rows.counts)
                              .Add(rows.revisions)
                              .Add(rows.checksums)
                              .AddBytes(payloads));
  if (!answer.ok()) return answer.status();
  if (answer->size() > 0) {
    NoteWritten(fence, batches.back().revision);
    return absl::OkStatus();
  }
  const auto heads = ReadHeads(connection, {fence.key});
  if (!heads.ok()) return heads.status();
  return WhyNotAppended(*heads, fence, first);
}

const char* AppendSql() { return kAppend.sql; }

}  // namespace revisit::server
