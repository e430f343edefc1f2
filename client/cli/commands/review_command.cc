#include "client/cli/commands/review_command.h"

#include <algorithm>
#include <iostream>
#include <memory>
#include <optional>
#include <set>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/answers/pages.h"
#include "client/answers/review_text.h"
#include "client/cli/commands/candidate_decisions.h"
#include "client/cli/commands/shared_flags.h"
#include "client/revisit/candidate_watch.h"
#include "client/revisit/printable_text.h"
#include "client/revisit/status.h"
#include "client/terminal/output_file.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

constexpr char kReviewDetails[] =
    "Of a vehicle whose checks are stored. The most valuable open candidate is "
    "shown, and the next line of the input says what it is:\n"
    "  c  one place: as revisit confirm\n"
    "  r  not one place: as revisit reject\n"
    "  s  skip, as an empty line: it stays open\n"
    "  u  undo the last decision, and show its candidate again\n"
    "  q  quit, as the end of the input\n"
    "Then the next one is, by what the server makes of the decision.\n\n"
    "A candidate is shown once more where its loop closure contradicts others "
    "that agree with each other. Then c upholds the closure, and r deletes it.";

// An open candidate with its check.
struct Reviewed {
  v1::Check check;
  v1::CheckCandidate candidate;
};

// Finds what is shown next.
class Queue {
 public:
  Queue(const Client& client, const ReviewOptions& options)
      : client_(client), options_(options) {
    options_.filter.clear_states();
    options_.filter.add_states(v1::CANDIDATE_STATE_OPEN);
  }

  // The most valuable open candidate that was not passed. Each time by a list
  // from its beginning, since a decision changes the values of others.
  absl::StatusOr<std::optional<Reviewed>> Next() const {
    if (!next_.empty()) {
      auto found = Read(next_);
      if (!found.ok() || found->has_value()) return found;
    }
    std::optional<Reviewed> best;
    const absl::Status visited = VisitPages(
        Request(),
        [this](const v1::ListChecksRequest& asked) {
          return client_.ListChecks(asked);
        },
        [](const v1::ListChecksResponse& page) -> const auto& {
          return page.checks();
        },
        [&](const v1::ListChecksResponse& page) -> absl::StatusOr<bool> {
          for (const v1::Check& check : page.checks()) {
            if (!TakeBest(check, &best)) return false;
          }
          return true;
        },
        PageOrder::kChanging);
    if (!visited.ok()) return visited;
    return best;
  }

  // Is not shown any more.
  void Pass(const std::string& candidate) {
    passed_.insert(candidate);
    next_.clear();
  }

  // Is shown next, once more.
  void Return(const std::string& candidate) {
    passed_.erase(candidate);
    next_ = candidate;
  }

  // A candidate as the server knows it now; none if it is open no longer.
  absl::StatusOr<std::optional<Reviewed>> Read(const std::string& name) const {
    v1::GetCheckRequest request;
    request.set_name(name.substr(0, name.rfind("/candidates/")));
    const auto response = client_.GetCheck(request);
    if (absl::IsNotFound(response.status())) return std::nullopt;
    if (!response.ok()) return response.status();
    for (const v1::CheckCandidate& candidate : response->check().states()) {
      if (candidate.name() == name &&
          candidate.state() == v1::CANDIDATE_STATE_OPEN) {
        return Reviewed{response->check(), candidate};
      }
    }
    return std::nullopt;
  }

 private:
  v1::ListChecksRequest Request() const {
    constexpr int kPageChecks = 100;
    v1::ListChecksRequest request;
    request.set_parent(VehicleName(options_.vehicle));
    request.set_page_size(kPageChecks);
    *request.mutable_filter() = options_.filter;
    request.set_order(v1::LIST_CHECKS_ORDER_BY_VALUE);
    request.set_fresh_only(options_.fresh_only);
    return request;
  }

  // Whether the checks behind this one may have a better one.
  bool TakeBest(const v1::Check& check, std::optional<Reviewed>* best) const {
    double most = 0.0;
    for (const v1::CheckCandidate& candidate : check.states()) {
      if (!Matches(options_.filter, check, candidate)) continue;
      const double value = OrderingValue(candidate);
      most = std::max(most, value);
      if (passed_.count(candidate.name()) != 0) continue;
      if (!best->has_value() || value > OrderingValue((*best)->candidate)) {
        *best = Reviewed{check, candidate};
      }
    }
    return !best->has_value() || most > OrderingValue((*best)->candidate);
  }

  const Client& client_;
  ReviewOptions options_;
  std::set<std::string> passed_;
  // Name of the candidate whose decision was undone; empty if there is none.
  std::string next_;
};

// Works through the queue.
class Review {
 public:
  Review(const Client& client, const ReviewOptions& options,
         std::istream& answers, const Terminal& terminal)
      : client_(client),
        options_(options),
        answers_(answers),
        terminal_(terminal),
        queue_(client, options) {}

  absl::Status Run() {
    for (;;) {
      const auto next = queue_.Next();
      if (!next.ok()) return next.status();
      if (next->has_value()) Show(**next);
      const auto goes_on = next->has_value() ? Ask(**next) : AskAtEnd();
      if (!goes_on.ok()) return goes_on.status();
      if (absl::Status told = CheckOutput(terminal_.out); !told.ok()) {
        return told;
      }
      if (!*goes_on) break;
    }
    Note(absl::StrCat(confirmed_, " confirmed, ", rejected_, " rejected, ",
                      skipped_, " skipped"));
    return absl::OkStatus();
  }

 private:
  void Show(const Reviewed& shown) const {
    if (terminal_.json()) {
      terminal_.out << JsonText(ForReview(shown.check, shown.candidate), false)
                    << '\n';
    } else {
      PrintForReview(shown.check, shown.candidate, terminal_.out);
    }
    terminal_.out << std::flush;
  }

  // Asks, and reads a line, without blanks; none at the end of the input.
  std::optional<std::string> Read(const std::string& question) const {
    terminal_.progress << question << " " << std::flush;
    std::string line;
    if (!std::getline(answers_, line)) return std::nullopt;
    return std::string(absl::StripAsciiWhitespace(line));
  }

  // Does what the lines say until one is done with the candidate. Returns
  // whether the review goes on.
  absl::StatusOr<bool> Ask(const Reviewed& shown) {
    for (;;) {
      const auto line = Read("confirm, reject, skip, undo, quit [c/r/s/u/q]?");
      if (!line.has_value() || *line == "q") return false;
      if (line->empty() || *line == "s") {
        Skip(shown.candidate.name());
        return true;
      }
      if (*line == "c" || *line == "r") return Decide(shown, *line == "c");
      if (*line == "u") {
        const auto undone = Undo();
        if (!undone.ok()) return undone.status();
        if (*undone) return true;
        continue;
      }
      Note(absl::StrCat("got \"", Printable(*line),
                        "\"; allowed is c (confirm), r (reject), s or an empty "
                        "line (skip), u (undo), q (quit)"));
    }
  }

  // Where nothing is left, the last decision may still be taken back.
  absl::StatusOr<bool> AskAtEnd() {
    Note("no more open candidates");
    while (!decisions_.empty()) {
      const auto line = Read("undo, quit [u/q]?");
      if (!line.has_value() || *line == "q" || line->empty()) return false;
      if (*line != "u") {
        Note(absl::StrCat("got \"", Printable(*line),
                          "\"; allowed is u (undo), q or an empty line "
                          "(quit)"));
        continue;
      }
      const auto undone = Undo();
      if (!undone.ok()) return undone.status();
      if (*undone) return true;
    }
    return false;
  }

  void Skip(const std::string& candidate) {
    ++skipped_;
    queue_.Pass(candidate);
    Tell("skipped", candidate);
  }

  absl::StatusOr<bool> Decide(const Reviewed& shown, bool confirms) {
    const std::string& name = shown.candidate.name();
    // Whoever looks takes their time, and others decide meanwhile.
    const auto now = queue_.Read(name);
    if (!now.ok()) return now.status();
    queue_.Pass(name);
    if (!now->has_value()) {
      Note(absl::StrCat("too late for ", Printable(name),
                        ": it is open no longer"));
      return true;
    }
    const v1::Candidate* const found =
        EvidenceOf((*now)->check, (*now)->candidate);
    if (found == nullptr) {
      Note(absl::StrCat(Printable(name),
                        " is left open: no search tells its two poses"));
      return true;
    }
    const auto decided = (confirms ? &ConfirmCandidate : &RejectCandidate)(
        client_, (*now)->candidate, *found, options_.note);
    if (IsTooLate(decided.status())) {
      Note(absl::StrCat("too late for ", Printable(name), ": ",
                        Describe(decided.status())));
      return true;
    }
    if (!decided.ok()) return decided.status();
    ++(confirms ? confirmed_ : rejected_);
    Tell(WordOf(*decided), name);
    decisions_.push_back(*decided);
    return true;
  }

  static const char* WordOf(const CandidateDecision& decision) {
    switch (decision.kind) {
      case CandidateDecision::Kind::kConfirmed:
        return "confirmed";
      case CandidateDecision::Kind::kUpheld:
        return "upheld";
      case CandidateDecision::Kind::kRejected:
        break;
    }
    return "rejected";
  }

  // Takes the last decision back. Returns whether there was one that could be.
  absl::StatusOr<bool> Undo() {
    if (decisions_.empty()) {
      Note("nothing is left to undo");
      return false;
    }
    const CandidateDecision last = decisions_.back();
    if (last.kind == CandidateDecision::Kind::kUpheld) {
      // The next one is the one before.
      decisions_.pop_back();
      Note(absl::StrCat(Printable(last.made),
                        " was there before it was upheld, so that is not "
                        "undone; revisit closures delete deletes it"));
      return false;
    }
    const absl::Status undone = UndoDecision(client_, last);
    if (!undone.ok() && !absl::IsNotFound(undone)) return undone;
    decisions_.pop_back();
    --(last.kind == CandidateDecision::Kind::kRejected ? rejected_
                                                       : confirmed_);
    if (!undone.ok()) {
      Note(absl::StrCat("undone by somebody else: ", Describe(undone)));
    }
    Tell("undone", last.candidate);
    queue_.Return(last.candidate);
    return true;
  }

  void Tell(const std::string& decision, const std::string& candidate) const {
    if (terminal_.json()) {
      nlohmann::ordered_json json;
      json["decision"] = decision;
      json["candidate"] = candidate;
      terminal_.out << JsonText(json, false) << '\n';
    } else {
      terminal_.out << decision << " " << Printable(candidate) << "\n\n";
    }
    terminal_.out << std::flush;
  }

  void Note(const std::string& text) const {
    terminal_.progress << text << '\n' << std::flush;
  }

  const Client& client_;
  const ReviewOptions& options_;
  std::istream& answers_;
  const Terminal& terminal_;
  Queue queue_;
  // The decisions that stand, the last one at the end.
  std::vector<CandidateDecision> decisions_;
  int confirmed_ = 0;
  int rejected_ = 0;
  int skipped_ = 0;
};

}  // namespace

void AddReviewCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"review", "Works through the open candidates, the most valuable first.",
       kReviewDetails,
       "  revisit review shuttle-7\n"
       "  revisit review shuttle-7 --least-value 0.5 --note \"Eva, by eye\""});
  const auto options = std::make_shared<ReviewOptions>();
  command.AddText("VEHICLE", "TEXT", &options->vehicle, "Id, or name")
      .Required();
  AddCandidateThresholds(command, &options->filter);
  command.AddSwitch("--fresh-only", &options->fresh_only,
                    "Leave out what waits to be searched again");
  command.AddText("--note", "TEXT", &options->note,
                  "For people: goes with every decision");
  command.Runs([options](const Connection& server, const Terminal& terminal) {
    return RunReview(server.client, *options, std::cin, terminal);
  });
}

absl::Status RunReview(const Client& client, const ReviewOptions& options,
                       std::istream& answers, const Terminal& terminal) {
  return Review(client, options, answers, terminal).Run();
}

}  // namespace revisit::client
