// revisit evaluate
#ifndef REVISIT_CLIENT_CLI_COMMANDS_EVALUATE_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_EVALUATE_COMMAND_H_

#include "client/cli/flags.h"

namespace revisit::client {

// The command is carried out by RunEvaluate() in run_evaluation.h.
void AddEvaluateCommand(const Command& program);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_EVALUATE_COMMAND_H_
