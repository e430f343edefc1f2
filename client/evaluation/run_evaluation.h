// Measures candidates on recorded drives whose truth is known.
#ifndef REVISIT_CLIENT_EVALUATION_RUN_EVALUATION_H_
#define REVISIT_CLIENT_EVALUATION_RUN_EVALUATION_H_

#include "absl/status/status.h"
#include "client/evaluation/evaluate_options.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

// Streams the estimates of each drive into a vehicle of its own, with checks,
// and judges the answers against the truth, which never leaves this process.
//
// With --json it prints {"drives": [...], "total": {...}, "methods": [...],
// "repeats", "notes"}. Each drive and total has drive, checks, true_loops,
// accepted, accepted_correct, top1_correct, top5_correct, precision, recall,
// f1, top1, recall_at_5, sure_correct, sure_recall (right and stated at 0.9 or
// more), candidates_to_verify, loops_found, candidates_per_loop_found,
// positive_calibration_error (of what is stated at 0.1 or more),
// expected_calibration_error, precision_95, recall_95, f1_95 and
// positive_calibration_error_95 ([low, high], see bootstrap.h), confirmed,
// rejected, jumps, query_ms_p50, query_ms_p99, poses, poses_per_second; null
// where there is nothing to divide by. Drives have seed, inflation and
// linked_after_meters too, null where there is none, and with `verbose`
// check_list. Where drives are recordings of one vehicle, new_road_checks and
// new_road_accepted tell of places that no other one has been at
// (evaluation.h). `drives` and `total` are those of the settings; each of
// `methods` has method, sequence_length_meters, claimed_scale (null unless
// claims are swept), drives, total, precision_recall (a list of threshold,
// precision, recall) and reliability (null, or a list of low, high, count,
// mean_stated, share_correct).
//
// ABORTED, as a fault of this machine, if a repeat answers otherwise.
absl::Status RunEvaluate(const EvaluateOptions& options,
                         const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_RUN_EVALUATION_H_
