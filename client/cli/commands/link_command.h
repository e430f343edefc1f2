// revisit link add|reject|list|delete
#ifndef REVISIT_CLIENT_CLI_COMMANDS_LINK_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_LINK_COMMAND_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "client/cli/commands/verified_measurement.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddLinkCommand(const Command& program);

// A pose of a vehicle in a group.
struct LinkEnd {
  // Id, or name.
  std::string vehicle;
  std::uint64_t sequence = 0;
};

// Reads VEHICLE@SEQUENCE. Says what is allowed in its place, or nothing if it
// was read.
std::string ReadLinkEnd(const std::string& text, LinkEnd* end);

struct NewLink {
  // Id, or name.
  std::string group;
  LinkEnd query;
  LinkEnd matched;
  VerifiedMeasurement measured;
  // Last part of its name; the server makes one of the poses if it is empty.
  std::string id;
};

struct NewRejection {
  // Id, or name.
  std::string group;
  LinkEnd query;
  LinkEnd matched;
  std::string note;
  // Last part of its name; the server makes one of the poses if it is empty.
  std::string id;
};

// Adds a loop closure between two vehicles. Prints its name and the revision of
// the group; as JSON, the response. REQUIRES: CheckMeasurement().
absl::Status RunLinkAdd(const Client& client, const NewLink& link,
                        const Terminal& terminal);
// The same of a rejected candidate.
absl::Status RunLinkReject(const Client& client, const NewRejection& rejection,
                           const Terminal& terminal);
// Lists those of all pages. As JSON: {"loopClosures": [...]}. DATA_LOSS if rows
// of others are damaged, below those that can be read.
absl::Status RunLinkList(const Client& client, const std::string& group,
                         const Terminal& terminal);
// Lists rejected candidates alike; as JSON: {"rejectedCandidates": [...]}.
absl::Status RunLinkRejections(const Client& client, const std::string& group,
                               const Terminal& terminal);
// A loop closure between two vehicles, or a rejected candidate.
struct LinkReference {
  // Id, or name.
  std::string group;
  // Either its id or resource name, or its two ends in the order in which they
  // were added.
  std::vector<std::string> words;
  bool is_rejected = false;
};

// Says what is wrong with the words; empty if nothing is.
std::string CheckLink(const LinkReference& link);

// Deletes one. NOT_FOUND if there is none of these ends, FAILED_PRECONDITION if
// there are several, which only differ by their ids. Prints its name and the
// revision of the group; as JSON, {"name", "revision"}. REQUIRES: CheckLink().
absl::Status RunLinkDelete(const Client& client, const LinkReference& link,
                           const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_LINK_COMMAND_H_
