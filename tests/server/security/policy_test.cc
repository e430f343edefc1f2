#include "server/security/policy.h"

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::HasSubstr;

constexpr char kPolicy[] = R"({
  "version": 1,
  "tenants": [
    {"name": "acme", "vehicle_prefix": "acme-"},
    {"name": "umbra", "vehicle_prefix": "umbra-",
     "max_search_steps_per_second": 5e7}
  ],
  "grants": [
    {"token_subject": "acme-backend", "tenant": "acme",
     "vehicles": ["*"], "verbs": ["read", "write", "admin"]},
    {"token_subject": "vehicle:*", "tenant": "umbra",
     "vehicles": ["umbra-{match}", "umbra-shared-*"], "verbs": ["write"]},
    {"token_claim": {"name": "groups", "value": "umbra-viewers"},
     "tenant": "umbra", "vehicles": ["*"], "verbs": ["read"]},
    {"certificate_uri": "spiffe://fleet.example/acme/*", "tenant": "acme",
     "vehicles": ["acme-{match}"], "verbs": ["read", "write"]},
    {"certificate_dns": "*.operators.example", "tenant": "*",
     "vehicles": ["*"], "verbs": ["read"]}
  ]
})";

Policy TestPolicy() { return Policy::Parse(kPolicy).value(); }

Identity Subject(const std::string& subject) {
  Identity identity;
  identity.token_subject = subject;
  identity.token_claims["sub"] = {subject};
  return identity;
}

Identity Uri(const std::string& uri) {
  Identity identity;
  identity.certificate_uris = {uri};
  return identity;
}

// Who a policy makes of an identity that it knows.
Caller CallerFor(const Identity& identity) {
  Caller caller;
  EXPECT_THAT(TestPolicy().Apply(identity, &caller), IsOk());
  return caller;
}

testing::AssertionResult IsNobody(const Identity& identity) {
  Caller caller;
  const absl::Status status = TestPolicy().Apply(identity, &caller);
  if (status.code() == StatusCode::kPermissionDenied &&
      ReasonOf(status) == "NOT_GRANTED") {
    return testing::AssertionSuccess();
  }
  return testing::AssertionFailure() << status.ToString();
}

TEST(PolicyTest, SubjectHasWhatItsTenantHas) {
  const Caller caller = CallerFor(Subject("acme-backend"));
  EXPECT_EQ(caller.tenant, "acme");
  EXPECT_TRUE(caller.May(Verb::kAdmin, "acme-7"));
  EXPECT_FALSE(caller.MaySee("umbra-7"));
}

// A policy with a grant of acme's, which has this member besides.
std::string PolicyWith(const std::string& member) {
  return R"({"version": 1, "tenants": [
    {"name": "acme", "vehicle_prefix": "acme-"},
    {"name": "umbra", "vehicle_prefix": "umbra-"}], "grants": [
    {"token_subject": "fleet:*", "tenant": "acme", "vehicles": ["acme-{match}-*"],
     "verbs": ["read", "write"])" +
         member + "}]}";
}

absl::StatusOr<Caller> CallerOf(const std::string& policy,
                                const std::string& subject) {
  const auto parsed = Policy::Parse(policy);
  if (!parsed.ok()) return parsed.status();
  Caller caller;
  const absl::Status status = parsed->Apply(Subject(subject), &caller);
  if (!status.ok()) return status;
  return caller;
}

TEST(PolicyTest, PatternsOfVehiclesHoldForGroupsWhereThereAreNoOthers) {
  const auto caller = CallerOf(PolicyWith(""), "fleet:bus");
  ASSERT_THAT(caller, IsOk());
  EXPECT_TRUE(caller->May(Verb::kWrite, "acme-bus-1", Resource::kGroup));
  EXPECT_FALSE(caller->MaySee("acme-tram-1", Resource::kGroup));
  EXPECT_FALSE(caller->May(Verb::kAdmin, "acme-bus-1", Resource::kGroup));
}

TEST(PolicyTest, PatternsOfGroupsHoldForGroupsAlone) {
  const auto caller = CallerOf(
      PolicyWith(R"(, "groups": ["*{match}-site", "acme-all"])"), "fleet:bus");
  ASSERT_THAT(caller, IsOk());
  EXPECT_TRUE(caller->May(Verb::kRead, "acme-bus-site", Resource::kGroup));
  EXPECT_TRUE(caller->May(Verb::kRead, "acme-all", Resource::kGroup));
  EXPECT_FALSE(caller->MaySee("acme-bus-1", Resource::kGroup));
  EXPECT_FALSE(caller->MaySee("acme-all"));
  // Patterns never reach beyond the tenant's prefix.
  EXPECT_FALSE(caller->MaySee("umbra-bus-site", Resource::kGroup));
  EXPECT_EQ(caller->PrefixesOf(Verb::kRead, Resource::kGroup),
            std::vector<std::string>{"acme-"});
  EXPECT_EQ(caller->PrefixesOf(Verb::kRead),
            std::vector<std::string>{"acme-bus-"});
}

TEST(PolicyTest, EmptyListOfGroupsGrantsNone) {
  const auto caller = CallerOf(PolicyWith(R"(, "groups": [])"), "fleet:bus");
  ASSERT_THAT(caller, IsOk());
  EXPECT_TRUE(caller->MaySee("acme-bus-1"));
  EXPECT_FALSE(caller->MaySee("acme-bus-1", Resource::kGroup));
}

TEST(PolicyTest, PatternsOfGroupsAreCheckedAsThoseOfVehicles) {
  for (const char* groups : {R"("*")", R"(["A"])", R"([1])", R"([""])"}) {
    EXPECT_THAT(
        Policy::Parse(PolicyWith(std::string(R"(, "groups": )") + groups))
            .status(),
        IsError(StatusCode::kInvalidArgument, _, HasSubstr("grants[0].groups")))
        << groups;
  }
}

TEST(PolicyTest, CallerKnowsWhichIdsAreOfOneTenant) {
  const auto caller = CallerOf(PolicyWith(""), "fleet:bus");
  ASSERT_THAT(caller, IsOk());
  EXPECT_TRUE(caller->AreOfOneTenant("acme-1", "acme-2"));
  EXPECT_TRUE(caller->AreOfOneTenant("nobodys-1", "nobodys-2"));
  EXPECT_FALSE(caller->AreOfOneTenant("acme-1", "umbra-1"));
  EXPECT_FALSE(caller->AreOfOneTenant("acme-1", "nobodys-1"));
  EXPECT_TRUE(Caller().AreOfOneTenant("acme-1", "umbra-1"));
}

TEST(PolicyTest, MatchStandsForWhatTheStarOfTheNameMatched) {
  const Caller caller = CallerFor(Uri("spiffe://fleet.example/acme/bus-7"));
  EXPECT_TRUE(caller.May(Verb::kWrite, "acme-bus-7"));
  EXPECT_FALSE(caller.MaySee("acme-bus-70"));
  EXPECT_FALSE(caller.MaySee("acme-bus"));
}

TEST(PolicyTest, MatchIsNeverAPattern) {
  for (const char* name : {"*", "b*", "B", "a b", "%2e", "..", "a_b"}) {
    EXPECT_TRUE(
        IsNobody(Uri(std::string("spiffe://fleet.example/acme/") + name)))
        << name;
  }
  // What is granted without {match} still is.
  const Caller caller = CallerFor(Subject("vehicle:*"));
  EXPECT_TRUE(caller.May(Verb::kWrite, "umbra-shared-1"));
  EXPECT_FALSE(caller.MaySee("umbra-1"));
}

TEST(PolicyTest, StarOfANameIsNotEmptyAndCrossesNoSlash) {
  EXPECT_TRUE(IsNobody(Uri("spiffe://fleet.example/acme/")));
  EXPECT_TRUE(IsNobody(Uri("spiffe://fleet.example/acme/a/b")));
  EXPECT_TRUE(IsNobody(Uri("xspiffe://fleet.example/acme/a")));
}

TEST(PolicyTest, NamesOfOneKindAreNotTakenForAnother) {
  Identity identity;
  identity.certificate_dns_names = {"spiffe://fleet.example/acme/bus"};
  EXPECT_TRUE(IsNobody(identity));
  EXPECT_TRUE(IsNobody(Uri("acme-backend")));
  EXPECT_TRUE(IsNobody(Subject("spiffe://fleet.example/acme/bus")));
  EXPECT_TRUE(IsNobody(Subject("ACME-backend")));
  EXPECT_TRUE(IsNobody(Subject("")));
}

TEST(PolicyTest, ClaimIsTheTextOrAnArrayWithIt) {
  for (const auto& groups :
       {std::vector<std::string>{"umbra-viewers"},
        std::vector<std::string>{"others", "umbra-viewers"}}) {
    Identity identity = Subject("somebody");
    identity.token_claims["groups"] = groups;
    const Caller caller = CallerFor(identity);
    EXPECT_EQ(caller.tenant, "umbra");
    EXPECT_TRUE(caller.May(Verb::kRead, "umbra-1"));
    EXPECT_FALSE(caller.May(Verb::kWrite, "umbra-1"));
  }
  Identity identity = Subject("somebody");
  identity.token_claims["group"] = {"umbra-viewers"};
  EXPECT_TRUE(IsNobody(identity));
}

TEST(PolicyTest, GrantsOfOneTenantAddUp) {
  Identity identity = Subject("vehicle:7");
  identity.token_claims["groups"] = {"umbra-viewers"};
  const Caller caller = CallerFor(identity);
  EXPECT_TRUE(caller.May(Verb::kWrite, "umbra-7"));
  EXPECT_TRUE(caller.May(Verb::kRead, "umbra-8"));
  EXPECT_FALSE(caller.May(Verb::kWrite, "umbra-8"));
}

TEST(PolicyTest, GrantsOfTwoTenantsAreRefused) {
  Identity identity = Subject("acme-backend");
  identity.token_claims["groups"] = {"umbra-viewers"};
  Caller caller;
  EXPECT_THAT(TestPolicy().Apply(identity, &caller),
              IsError(StatusCode::kPermissionDenied, "NOT_GRANTED",
                      HasSubstr("more than one tenant")));
}

TEST(PolicyTest, StarTenantHasAllVehicles) {
  Identity identity;
  identity.certificate_dns_names = {"a.operators.example"};
  const Caller caller = CallerFor(identity);
  EXPECT_EQ(caller.tenant, "*");
  EXPECT_TRUE(caller.May(Verb::kRead, "acme-1"));
  EXPECT_TRUE(caller.May(Verb::kRead, "anything"));
  EXPECT_FALSE(caller.May(Verb::kWrite, "anything"));
}

TEST(PolicyTest, BudgetOfSearchStepsIsThatOfTheTenant) {
  EXPECT_EQ(CallerFor(Subject("vehicle:7")).max_search_steps_per_second, 5e7);
  EXPECT_EQ(CallerFor(Subject("acme-backend")).max_search_steps_per_second,
            std::nullopt);
  Identity operators;
  operators.certificate_dns_names = {"a.operators.example"};
  EXPECT_EQ(CallerFor(operators).max_search_steps_per_second, std::nullopt);
}

TEST(PolicyTest, ProblemsAreNamedWithTheirPlace) {
  const std::string tenants =
      R"("tenants": [{"name": "a", "vehicle_prefix": "a-"}])";
  const auto grant = [&](const std::string& members) {
    return "{\"version\": 1, " + tenants + ", \"grants\": [{" + members + "}]}";
  };
  const auto with_tenants = [](const std::string& list) {
    return "{\"version\": 1, \"tenants\": [" + list + "], \"grants\": []}";
  };
  const struct {
    std::string text;
    const char* problem;
  } kCases[] = {
      {"", "line 1, column 1"},
      {"{\n \"version\": 1,\n}", "line 3, column 1"},
      {"{\"a\xff\": 1}", "invalid string: ill-formed UTF-8"},
      {"[]", "policy: not an object"},
      {"{}", "policy: \"version\" is missing"},
      {R"({"version": 1, "version": 1, "tenants": [], "grants": []})",
       "the key \"version\" stands twice"},
      {R"({"version": 2, "tenants": [], "grants": []})",
       "version: got 2; this server knows version 1"},
      {R"({"version": 1, "tenants": [], "grants": [], "user": 1})",
       "policy: unknown key \"user\""},
      {R"({"version": 1, "tenants": {}, "grants": []})",
       "tenants: not an array"},
      {R"({"version": 1, "tenants": [], "grants": 1})", "grants: not an array"},
      {with_tenants("1"), "tenants[0]: not an object"},
      {with_tenants(R"({"name": "a"})"),
       "tenants[0]: \"vehicle_prefix\" is missing"},
      {with_tenants(R"({"name": "A", "vehicle_prefix": "a-"})"),
       "tenants[0].name: got \"A\""},
      {with_tenants(R"({"name": "*", "vehicle_prefix": "a-"})"),
       "tenants[0].name: got \"*\""},
      {with_tenants(R"({"name": "a", "vehicle_prefix": "-a"})"),
       "tenants[0].vehicle_prefix: got \"-a\""},
      {with_tenants(R"({"name": "a", "vehicle_prefix": "a*"})"),
       "tenants[0].vehicle_prefix: got \"a*\""},
      {with_tenants(R"({"name": "a", "vehicle_prefix": "a"},
                       {"name": "b", "vehicle_prefix": "ab"})"),
       "tenants[1].vehicle_prefix: got \"ab\", and that of a is \"a\""},
      {with_tenants(R"({"name": "a", "vehicle_prefix": ""},
                       {"name": "b", "vehicle_prefix": "b"})"),
       "tenants[1].vehicle_prefix: got \"b\""},
      {with_tenants(R"({"name": "a", "vehicle_prefix": "a"},
                       {"name": "a", "vehicle_prefix": "b"})"),
       "tenants[1].name: \"a\" stands twice"},
      {with_tenants(R"({"name": "a", "vehicle_prefix": "a",
                        "max_search_steps_per_second": "1"})"),
       "tenants[0].max_search_steps_per_second: got \"1\"; allowed is a number "
       "in [1, 1e15]"},
      {with_tenants(R"({"name": "a", "vehicle_prefix": "a",
                        "max_search_steps_per_second": 0.5})"),
       "tenants[0].max_search_steps_per_second: got 0.5"},
      {with_tenants(R"({"name": "a", "vehicle_prefix": "a",
                        "max_search_steps_per_second": 1e16})"),
       "tenants[0].max_search_steps_per_second: got 1e+16"},
      {grant(R"("tenant": "a", "vehicles": ["*"], "verbs": ["read"])"),
       "grants[0]: names who it is for 0 times"},
      {grant(R"("token_subject": "s", "certificate_dns": "d", "tenant": "a",
                "vehicles": ["*"], "verbs": ["read"])"),
       "grants[0]: names who it is for 2 times"},
      {grant(R"("token_subject": 1, "tenant": "a", "vehicles": ["*"],
                "verbs": ["read"])"),
       "grants[0].token_subject: not a text"},
      {grant(R"("token_subject": "", "tenant": "a", "vehicles": ["*"],
                "verbs": ["read"])"),
       "grants[0].token_subject: got \"\""},
      {grant(R"("token_subject": "*a*", "tenant": "a", "vehicles": ["*"],
                "verbs": ["read"])"),
       "grants[0].token_subject: got \"*a*\""},
      {grant(R"("token_claim": "groups", "tenant": "a", "vehicles": ["*"],
                "verbs": ["read"])"),
       "grants[0].token_claim: not an object"},
      {grant(R"("token_claim": {"name": "groups"}, "tenant": "a",
                "vehicles": ["*"], "verbs": ["read"])"),
       "grants[0].token_claim: \"value\" is missing"},
      {grant(R"("subject": "s", "tenant": "a", "vehicles": ["*"],
                "verbs": ["read"])"),
       "grants[0]: unknown key \"subject\""},
      {grant(R"("token_subject": "s", "vehicles": ["*"], "verbs": ["read"])"),
       "grants[0]: \"tenant\" is missing"},
      {grant(R"("token_subject": "s", "tenant": "b", "vehicles": ["*"],
                "verbs": ["read"])"),
       "grants[0].tenant: got \"b\", which is not among tenants"},
      {grant(R"("token_subject": "s", "tenant": "a", "vehicles": "*",
                "verbs": ["read"])"),
       "grants[0].vehicles: not an array of one text or more"},
      {grant(R"("token_subject": "s", "tenant": "a", "vehicles": [],
                "verbs": ["read"])"),
       "grants[0].vehicles: not an array of one text or more"},
      {grant(R"("token_subject": "s", "tenant": "a", "vehicles": ["*", "A"],
                "verbs": ["read"])"),
       "grants[0].vehicles[1]: got \"A\""},
      {grant(R"("token_subject": "s*", "tenant": "a",
                "vehicles": ["{match}{match}"], "verbs": ["read"])"),
       "grants[0].vehicles[0]: got \"{match}{match}\""},
      {grant(R"("token_subject": "s", "tenant": "a", "vehicles": ["{match}"],
                "verbs": ["read"])"),
       "grants[0].vehicles[0]: {match} stands for nothing"},
      {grant(R"("token_subject": "s", "tenant": "a", "vehicles": ["*"],
                "verbs": ["read", "writ"])"),
       "grants[0].verbs[1]: got \"writ\"; allowed is read, write and admin"},
      {grant(R"("token_subject": "s", "tenant": "a", "vehicles": ["*"],
                "verbs": [1])"),
       "grants[0].verbs[0]: not a text"},
      {std::string(100, '[') + std::string(100, ']'), "nested deeper than 16"},
  };
  for (const auto& test : kCases) {
    const auto policy = Policy::Parse(test.text);
    EXPECT_EQ(policy.status().code(), StatusCode::kInvalidArgument)
        << test.text;
    EXPECT_THAT(std::string(policy.status().message()), HasSubstr(test.problem))
        << test.text;
  }
}

}  // namespace
}  // namespace revisit::server
