// Tests of commands have a fake server and terminals that keep the output.
#ifndef REVISIT_TESTS_CLIENT_CLI_COMMANDS_COMMAND_TEST_H_
#define REVISIT_TESTS_CLIENT_CLI_COMMANDS_COMMAND_TEST_H_

#include <memory>
#include <sstream>
#include <vector>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/channel.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "grpcpp/channel.h"
#include "gtest/gtest.h"
#include "tests/client/fake_server.h"

namespace revisit::client {

class CommandTest : public ::testing::Test {
 protected:
  Terminal Text() { return {out_, progress_, false}; }
  Terminal Json() { return As(OutputFormat::kJson); }
  Terminal As(OutputFormat format) { return {out_, progress_, false, format}; }

  // Runs a whole command line, behind the name of the program, of the command
  // that `add` adds.
  absl::Status RunLine(void (*add)(const Command&),
                       std::vector<const char*> words,
                       const Terminal& terminal) {
    CommandLine line({"revisit", "", "", ""});
    add(line.program());
    words.insert(words.begin(), "revisit");
    const auto parsed =
        line.Parse(static_cast<int>(words.size()), words.data());
    if (!parsed.ok()) return parsed.status();
    return parsed->run({{}, channel_, Client(channel_)}, terminal);
  }

  // Stores poses 1 to `count` of this vehicle, each as many metres along x as
  // its sequence says.
  void Append(int count) {
    v1::PoseBatch batch;
    for (int i = 1; i <= count; ++i) {
      v1::Pose* pose = batch.add_poses();
      pose->set_sequence(static_cast<std::uint64_t>(i));
      pose->mutable_local()->set_x_meters(i);
      pose->set_heading_radians(0.5);
    }
    server_.Replace("first", batch);
  }

  FakeServer server_;
  std::shared_ptr<grpc::Channel> channel_ =
      MakeInsecureChannel(server_.address());
  Client client_{channel_};
  std::ostringstream out_;
  std::ostringstream progress_;
};

}  // namespace revisit::client

#endif  // REVISIT_TESTS_CLIENT_CLI_COMMANDS_COMMAND_TEST_H_
