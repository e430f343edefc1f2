// Manual pages, as man(7) describes them.
#ifndef REVISIT_CLIENT_CLI_USAGE_MAN_PAGE_H_
#define REVISIT_CLIENT_CLI_USAGE_MAN_PAGE_H_

#include <string>
#include <vector>

#include "client/cli/usage/command_usage.h"

namespace revisit::client {

struct ManPage {
  // Such as "revisit-vehicle-create.1".
  std::string file;
  std::string text;
};

// Stands in the foot of each page.
struct ManPageFoot {
  // YYYY-MM-DD.
  std::string date;
  // Such as "revisit 1.2.3".
  std::string version;
};

// A page for the program and one for each command that is not hidden.
std::vector<ManPage> ManPages(const CommandUsage& program,
                              const ManPageFoot& foot);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_USAGE_MAN_PAGE_H_
