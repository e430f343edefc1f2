// revisit evaluate
#ifndef REVISIT_CLIENT_CLI_COMMANDS_EVALUATE_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_EVALUATE_COMMAND_H_

#include "client/cli/connection_flags.h"
#include "client/cli/flags.h"

namespace revisit::client {

// The command is carried out by RunEvaluate() in run_evaluation.h. `connection`
// has what the program's flags were given and must outlive the command.
void AddEvaluateCommand(const Command& program,
                        const ConnectionFlags* connection);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_EVALUATE_COMMAND_H_
