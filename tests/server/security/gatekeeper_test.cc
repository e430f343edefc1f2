#include "server/security/gatekeeper.h"

#include <atomic>
#include <cstdio>
#include <fstream>
#include <future>
#include <sstream>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"
#include "tests/server/security/certificate_testing.h"
#include "tests/server/security/token_testing.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using std::chrono::hours;
using std::chrono::milliseconds;
using ::testing::_;
using ::testing::HasSubstr;

std::string PolicyFor(const std::string& subject) {
  return R"({"version": 1,
    "tenants": [{"name": "acme", "vehicle_prefix": "acme-"}],
    "grants": [
      {"token_subject": ")" +
         subject + R"(", "tenant": "acme", "vehicles": ["*"],
       "verbs": ["read"]},
      {"certificate_uri": "urn:bus", "tenant": "acme", "vehicles": ["acme-bus"],
       "verbs": ["write"]}]})";
}

class GatekeeperTest : public testing::Test {
 protected:
  GatekeeperTest() {
    Put("policy", PolicyFor("backend"));
    Put("keys", KeySet({key_.Jwk("k")}));
    settings_.policy_file = directory_.File("policy");
    settings_.token_keys_file = directory_.File("keys");
    settings_.token_rules = {"issuer", "audience", std::chrono::seconds(0)};
    settings_.takes_certificates = true;
    settings_.check_period = milliseconds(10);
  }

  // In one step, as a file that is in use is to be replaced.
  void Put(const std::string& name, const std::string& text) {
    std::ofstream(directory_.File("new")) << text;
    std::rename(directory_.File("new").c_str(), directory_.File(name).c_str());
  }
  std::unique_ptr<Gatekeeper> Start() {
    return StartGatekeeper(settings_, &log_).value();
  }
  std::string Token(Gatekeeper::Time expires,
                    const std::string& subject = "backend") const {
    return key_.Token(
        R"({"alg":"EdDSA","kid":"k"})",
        R"({"iss":"issuer","aud":"audience","sub":")" + subject +
            R"(","exp":)" +
            std::to_string(std::chrono::system_clock::to_time_t(expires)) +
            "}");
  }
  Credentials Bearer(const std::string& token) const {
    return {{"Bearer " + token}, ""};
  }
  // Waits until whoever watches has been asked again `times` times from now.
  static void AwaitRechecks(Gatekeeper* gatekeeper, int times) {
    std::promise<void> reached;
    std::atomic<int> left{times};
    const auto id = gatekeeper->Watch(Gatekeeper::Time::max(), [&] {
      if (--left == 0) reached.set_value();
    });
    reached.get_future().wait();
    gatekeeper->Unwatch(id);
    // The last call may still be under way: the next one begins after it.
    std::promise<void> over;
    std::atomic<bool> first{true};
    const auto next = gatekeeper->Watch(Gatekeeper::Time::max(), [&] {
      if (first.exchange(false)) over.set_value();
    });
    over.get_future().wait();
    gatekeeper->Unwatch(next);
  }

  TemporaryDirectory directory_;
  std::ostringstream stream_;
  Log log_{LogFormat::kText, LogLevel::kInfo, &stream_};
  const SigningKey key_{SigningKey::Kind::kEd25519};
  GatekeeperSettings settings_;
};

TEST_F(GatekeeperTest, KnowsACallerByToken) {
  const auto gatekeeper = Start();
  const auto expires = Now() + hours(1);
  for (const char* scheme : {"Bearer ", "bearer ", "BEARER "}) {
    const auto caller =
        gatekeeper->Admit({{scheme + Token(expires)}, ""}, Now());
    ASSERT_THAT(caller, IsOk());
    EXPECT_EQ((*caller)->identity, "token:backend");
    EXPECT_EQ((*caller)->tenant, "acme");
    EXPECT_TRUE((*caller)->May(Verb::kRead, "acme-1"));
  }
}

TEST_F(GatekeeperTest, KnowsACallerByCertificate) {
  CertificateRequest request;
  request.alternative_names = "URI:urn:bus";
  const TestCertificate certificate(request);
  const auto gatekeeper = Start();
  const auto caller = gatekeeper->Admit({{}, certificate.Pem()}, Now());
  ASSERT_THAT(caller, IsOk());
  EXPECT_EQ((*caller)->identity, "certificate:urn:bus");
  EXPECT_TRUE((*caller)->May(Verb::kWrite, "acme-bus"));
  EXPECT_FALSE((*caller)->MaySee("acme-1"));
  EXPECT_THAT(gatekeeper->Admit({{}, certificate.Pem()}, Now() + hours(9000)),
              IsError(StatusCode::kUnauthenticated, "CERTIFICATE_EXPIRED", _));
  // The token says who calls, if there is one.
  EXPECT_EQ(
      (*gatekeeper->Admit(
           {{"Bearer " + Token(Now() + hours(1))}, certificate.Pem()}, Now()))
          ->identity,
      "token:backend");
  EXPECT_THAT(gatekeeper->Admit({{"Bearer x"}, certificate.Pem()}, Now()),
              IsError(StatusCode::kUnauthenticated, "CREDENTIALS_INVALID", _));
}

TEST_F(GatekeeperTest, RefusesCallersThatShowNothingGood) {
  const auto gatekeeper = Start();
  const std::string token = Token(Now() + hours(1));
  EXPECT_THAT(gatekeeper->Admit({}, Now()),
              IsError(StatusCode::kUnauthenticated, "CREDENTIALS_MISSING",
                      HasSubstr("a bearer token in the metadata key "
                                "`authorization` or a client certificate")));
  for (const std::vector<std::string>& values :
       {std::vector<std::string>{""},
        {"Bearer"},
        {"Bearer "},
        {token},
        {"Basic " + token},
        {"Bearer  " + token},
        {"Bearer " + token + ","},
        {"Bearer " + token, "Bearer " + token}}) {
    EXPECT_THAT(
        gatekeeper->Admit({values, ""}, Now()),
        IsError(StatusCode::kUnauthenticated, "CREDENTIALS_INVALID", _));
  }
  EXPECT_THAT(gatekeeper->Admit(Bearer(Token(Now() - hours(1))), Now()),
              IsError(StatusCode::kUnauthenticated, "TOKEN_EXPIRED", _));
  EXPECT_THAT(
      gatekeeper->Admit(Bearer(Token(Now() + hours(1), "other")), Now()),
      IsError(StatusCode::kPermissionDenied, "NOT_GRANTED", _));
  const TestCertificate nameless{CertificateRequest()};
  EXPECT_THAT(gatekeeper->Admit({{}, nameless.Pem()}, Now()),
              IsError(StatusCode::kUnauthenticated, "CREDENTIALS_INVALID",
                      HasSubstr("no URI and no DNS name")));
}

TEST_F(GatekeeperTest, TakesOnlyWhatItIsToldToTake) {
  settings_.takes_certificates = false;
  CertificateRequest request;
  request.alternative_names = "URI:urn:bus";
  const TestCertificate certificate(request);
  EXPECT_THAT(Start()->Admit({{}, certificate.Pem()}, Now()),
              IsError(StatusCode::kUnauthenticated, "CREDENTIALS_MISSING", _));
  settings_.takes_certificates = true;
  settings_.token_keys_file.clear();
  EXPECT_THAT(Start()->Admit(Bearer(Token(Now() + hours(1))), Now()),
              IsError(StatusCode::kUnauthenticated, "CREDENTIALS_INVALID",
                      HasSubstr("takes no bearer tokens")));
}

TEST_F(GatekeeperTest, TokenThatWasKnownBeforeStillExpires) {
  const auto gatekeeper = Start();
  const std::string token = Token(Now() + hours(1));
  EXPECT_THAT(gatekeeper->Admit(Bearer(token), Now()), IsOk());
  EXPECT_THAT(gatekeeper->Admit(Bearer(token), Now()), IsOk());
  EXPECT_THAT(gatekeeper->Admit(Bearer(token), Now() + hours(2)),
              IsError(StatusCode::kUnauthenticated, "TOKEN_EXPIRED", _));
}

TEST_F(GatekeeperTest, FilesThatAreNoGoodAreRefusedAtTheStart) {
  Put("policy", "{}");
  EXPECT_THAT(StartGatekeeper(settings_, &log_).status().ToString(),
              HasSubstr("/policy: policy: \"version\" is missing"));
  Put("policy", PolicyFor("backend"));
  Put("keys", "{}");
  EXPECT_THAT(StartGatekeeper(settings_, &log_).status().ToString(),
              HasSubstr("/keys: not a key set"));
  settings_.token_keys_file = directory_.File("missing");
  EXPECT_THAT(StartGatekeeper(settings_, &log_).status().ToString(),
              HasSubstr("cannot read"));
}

TEST_F(GatekeeperTest, ChangedFilesAreTakenAndBadOnesAreNot) {
  const auto gatekeeper = Start();
  const auto backend = Bearer(Token(Now() + hours(1)));
  const auto other = Bearer(Token(Now() + hours(1), "other"));
  EXPECT_THAT(gatekeeper->Admit(backend, Now()), IsOk());
  const FilesState first = *gatekeeper->files();
  EXPECT_FALSE(first.refused);

  Put("policy", "{");
  AwaitRechecks(gatekeeper.get(), 2);
  EXPECT_THAT(gatekeeper->Admit(backend, Now()), IsOk());
  EXPECT_TRUE(gatekeeper->files()->refused);
  EXPECT_EQ(gatekeeper->files()->loaded, first.loaded);

  Put("policy", PolicyFor("other"));
  AwaitRechecks(gatekeeper.get(), 2);
  EXPECT_FALSE(gatekeeper->files()->refused);
  EXPECT_GT(gatekeeper->files()->loaded, first.loaded);
  EXPECT_THAT(gatekeeper->Admit(backend, Now()),
              IsError(StatusCode::kPermissionDenied, "NOT_GRANTED", _));
  EXPECT_THAT(gatekeeper->Admit(other, Now()), IsOk());

  // A key that is taken out of the set signs nothing any more.
  const SigningKey second(SigningKey::Kind::kP256);
  Put("keys", KeySet({second.Jwk("k2")}));
  AwaitRechecks(gatekeeper.get(), 2);
  EXPECT_THAT(gatekeeper->Admit(other, Now()),
              IsError(StatusCode::kUnauthenticated, "CREDENTIALS_INVALID",
                      HasSubstr("does not have the key")));
  EXPECT_THAT(stream_.str(), HasSubstr("access_rules_refused"));
  EXPECT_THAT(stream_.str(), HasSubstr("access_rules_loaded"));
}

TEST_F(GatekeeperTest, WatchersAreAskedWhenTheirTimeIsOver) {
  // Far longer than the test.
  settings_.check_period = hours(1);
  const auto gatekeeper = Start();
  std::promise<void> asked;
  const auto start = std::chrono::steady_clock::now();
  const auto id =
      gatekeeper->Watch(Now() + milliseconds(30), [&] { asked.set_value(); });
  asked.get_future().wait();
  EXPECT_GE(std::chrono::steady_clock::now() - start, milliseconds(25));
  gatekeeper->Unwatch(id);
}

TEST_F(GatekeeperTest, LooksAtItsFilesAtOnceIfItIsAsked) {
  // Far longer than the test.
  settings_.check_period = hours(1);
  const auto gatekeeper = Start();
  const auto other = Bearer(Token(Now() + hours(1), "other"));
  EXPECT_THAT(gatekeeper->Admit(other, Now()),
              IsError(StatusCode::kPermissionDenied, "NOT_GRANTED", _));
  Put("policy", PolicyFor("other"));
  std::promise<void> rechecked;
  const auto id = gatekeeper->Watch(Gatekeeper::Time::max(),
                                    [&] { rechecked.set_value(); });
  gatekeeper->LookAtFiles();
  rechecked.get_future().wait();
  EXPECT_THAT(gatekeeper->Admit(other, Now()), IsOk());
  gatekeeper->Unwatch(id);
}

TEST_F(GatekeeperTest, WatchersThatLeftAreNotAsked) {
  const auto gatekeeper = Start();
  std::atomic<int> asked{0};
  const auto id = gatekeeper->Watch(Gatekeeper::Time::max(), [&] { ++asked; });
  gatekeeper->Unwatch(id);
  AwaitRechecks(gatekeeper.get(), 2);
  const int before = asked;
  AwaitRechecks(gatekeeper.get(), 2);
  EXPECT_EQ(asked, before);
}

TEST(OpenGatekeeperTest, LetsEveryoneDoEverything) {
  const auto gatekeeper = MakeOpenGatekeeper();
  EXPECT_FALSE(gatekeeper->asks());
  EXPECT_FALSE(gatekeeper->files());
  const auto caller = gatekeeper->Admit({}, Now());
  ASSERT_THAT(caller, IsOk());
  EXPECT_TRUE((*caller)->May(Verb::kAdmin, "anything"));
  EXPECT_EQ((*caller)->tenant, "");
}

}  // namespace
}  // namespace revisit::server
