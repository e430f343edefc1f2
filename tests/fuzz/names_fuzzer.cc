// Names, ids and page tokens of callers, and what becomes of them in the log.
#include <nlohmann/json.hpp>
#include <sstream>
#include <string>

#include "server/base/logging.h"
#include "server/base/sequences.h"
#include "server/conversion/names.h"
#include "server/conversion/page_token.h"
#include "server/fields/field_violations.h"
#include "tests/fuzz/fuzzing.h"
#include "tests/fuzz/vehicles.h"

namespace {

using revisit::fuzz::Require;

bool IsPrintableLine(const std::string& text) {
  for (const char c : text) {
    if (c < ' ' || c > '~') return false;
  }
  return true;
}

// The line that a log writes about this.
std::string Logged(revisit::server::LogFormat format, const std::string& text) {
  std::ostringstream stream;
  revisit::server::Log(format, revisit::server::LogLevel::kInfo, &stream)
      .Write(revisit::server::LogLevel::kInfo, "call",
             {{"vehicle", text}, {"message", text}});
  return stream.str();
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data,
                                      std::size_t size) {
  namespace server = revisit::server;
  const std::string text = revisit::fuzz::Input(data, size).Rest();
  constexpr server::FieldPath kRequest;

  const auto id = server::ParseVehicleName(text, kRequest.Field("name"));
  revisit::fuzz::RequireGoodError(id.status());
  if (id.ok()) {
    Require(server::CheckId(*id, kRequest).ok(), "a name holds an id");
    Require(id->find_first_not_of("abcdefghijklmnopqrstuvwxyz0123456789-") ==
                std::string::npos,
            "an id is no path");
  }
  const absl::Status checked = server::CheckId(text, kRequest.Field("id"));
  revisit::fuzz::RequireGoodError(checked);
  Require(!checked.ok() || (!text.empty() && text.size() <= 63),
          "an id is short");
  for (const server::PairKind kind : server::kPairKinds) {
    revisit::fuzz::RequireGoodError(
        server::ParsePosePairName(kind, text, kRequest.Field("name")).status());
  }

  const auto key = server::ParsePageToken("list", text);
  revisit::fuzz::RequireGoodError(key.status());
  const auto own =
      server::ParsePageToken("list", server::MakePageToken("list", text));
  revisit::fuzz::RequireGoodError(own.status());
  Require(!checked.ok() || (own.ok() && *own == text),
          "a token that was made can be read");
  const auto sequence =
      server::ParseSequenceToken("list", server::MakePageToken("list", text));
  revisit::fuzz::RequireGoodError(sequence.status());
  Require(
      !sequence.ok() || (*sequence >= 1 && *sequence <= server::kMaxSequence &&
                         std::to_string(*sequence) == text),
      "a key of poses is a sequence");

  Require(IsPrintableLine(server::Quoted(text)), "a quotation is one line");
  std::string json = Logged(server::LogFormat::kJson, text);
  Require(!json.empty() && json.back() == '\n', "a line ends");
  json.pop_back();
  Require(IsPrintableLine(json), "an event is one line");
  Require(nlohmann::json::accept(json), "a line of the log is JSON");
  std::string plain = Logged(server::LogFormat::kText, text);
  plain.pop_back();
  Require(IsPrintableLine(plain), "an event is one line of text");
  return 0;
}
