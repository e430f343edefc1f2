#include "server/security/certificates.h"

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"
#include "tests/server/security/certificate_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using std::chrono::hours;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;

CertificateRequest Authority() {
  CertificateRequest request;
  request.common_name = "Test CA";
  request.is_authority = true;
  return request;
}

class CertificatesTest : public testing::Test {
 protected:
  TlsMaterial Good() const { return {leaf_.KeyPem(), leaf_.Pem(), ""}; }

  std::string ProblemOf(const TlsMaterial& material,
                        CertificateTime now = Now()) {
    const auto summary = CheckTlsMaterial(material, now);
    EXPECT_EQ(summary.status().code(), StatusCode::kInvalidArgument);
    EXPECT_THAT(std::string(summary.status().message()),
                Not(HasSubstr("PRIVATE KEY")));
    return std::string(summary.status().message());
  }

  const TestCertificate authority_{Authority()};
  const TestCertificate leaf_{CertificateRequest(), &authority_};
  const TestCertificate other_{CertificateRequest(), &authority_};
};

TEST_F(CertificatesTest, GoodMaterialIsTakenWithItsExpiry) {
  CertificateRequest request;
  request.until = Now() + hours(48);
  const TestCertificate leaf(request, &authority_);
  const auto summary = CheckTlsMaterial(
      {leaf.KeyPem(), leaf.Pem() + authority_.Pem(), authority_.Pem()}, Now());
  ASSERT_THAT(summary, IsOk());
  EXPECT_LE(summary->expires, request.until);
  EXPECT_GT(summary->expires, request.until - std::chrono::seconds(2));
  EXPECT_THAT(summary->serial_number, Not(IsEmpty()));
}

TEST_F(CertificatesTest, KeyHasToBeWholeAndTheCertificates) {
  TlsMaterial material = Good();
  material.private_key = other_.KeyPem();
  EXPECT_THAT(ProblemOf(material), HasSubstr("not that of the certificate"));
  for (const std::string& key :
       {std::string(), std::string("garbage"),
        leaf_.KeyPem().substr(0, leaf_.KeyPem().size() / 2), leaf_.Pem()}) {
    material.private_key = key;
    EXPECT_THAT(ProblemOf(material), HasSubstr("private key cannot be read"))
        << key;
  }
}

TEST_F(CertificatesTest, FilesCutAnywhereAreRefused) {
  const std::string whole = leaf_.Pem() + authority_.Pem();
  const std::string first = leaf_.Pem();
  for (std::size_t size = 0; size + 1 < whole.size(); ++size) {
    // All of the first certificate and nothing of the second is a good file.
    if (size == first.size() || size == first.size() - 1) continue;
    TlsMaterial material = Good();
    material.certificate_chain = whole.substr(0, size);
    EXPECT_THAT(ProblemOf(material), HasSubstr("file of certificates"))
        << size << " of " << whole.size();
  }
}

TEST_F(CertificatesTest, FilesWithOtherThingsAreRefused) {
  TlsMaterial material = Good();
  material.certificate_chain = leaf_.Pem() + leaf_.KeyPem();
  EXPECT_THAT(ProblemOf(material), HasSubstr("more than certificates"));
  material.certificate_chain = "garbage";
  EXPECT_THAT(ProblemOf(material), HasSubstr("holds no certificate"));
  material.certificate_chain = leaf_.Pem() + "garbage\n";
  EXPECT_THAT(ProblemOf(material), HasSubstr("cut short"));
  // A damaged letter.
  material.certificate_chain = leaf_.Pem();
  material.certificate_chain[200] ^= 1;
  EXPECT_THAT(ProblemOf(material), HasSubstr("certificate"));
}

TEST_F(CertificatesTest, ChainHasToBeInOrder) {
  const TestCertificate stranger(Authority());
  TlsMaterial material = Good();
  material.certificate_chain = leaf_.Pem() + other_.Pem();
  EXPECT_THAT(ProblemOf(material),
              HasSubstr("certificate 2 of the chain did not issue"));
  material.certificate_chain = authority_.Pem() + leaf_.Pem();
  EXPECT_THAT(ProblemOf(material), HasSubstr("not that of the certificate"));
}

TEST_F(CertificatesTest, TimeHasToBeNow) {
  CertificateRequest request;
  request.from = Now() - hours(48);
  request.until = Now() - hours(24);
  const TestCertificate expired(request, &authority_);
  EXPECT_THAT(ProblemOf({expired.KeyPem(), expired.Pem(), ""}),
              HasSubstr("the certificate has expired at 20"));
  EXPECT_THAT(CheckTlsMaterial({expired.KeyPem(), expired.Pem(), ""},
                               Now() - hours(36)),
              IsOk());
  EXPECT_THAT(ProblemOf(Good(), Now() - hours(24)),
              HasSubstr("the certificate is not valid before 20"));
}

TEST_F(CertificatesTest, WeakKeysAreRefusedAsTheListenerWould) {
  CertificateRequest request;
  request.rsa_bits = 1024;
  const TestCertificate weak(request, &authority_);
  EXPECT_THAT(ProblemOf({weak.KeyPem(), weak.Pem(), ""}),
              HasSubstr("key too small"));
}

TEST_F(CertificatesTest, ClientAuthoritiesHaveToBeAuthorities) {
  TlsMaterial material = Good();
  material.client_authorities = leaf_.Pem();
  EXPECT_THAT(ProblemOf(material),
              HasSubstr("client authority 1 is no certificate authority"));
  material.client_authorities = "garbage";
  EXPECT_THAT(ProblemOf(material),
              HasSubstr("the file of client authorities holds no certificate"));
  CertificateRequest request = Authority();
  request.until = Now() - std::chrono::minutes(1);
  const TestCertificate expired(request);
  material.client_authorities = expired.Pem();
  EXPECT_THAT(ProblemOf(material), HasSubstr("client authority 1 has expired"));
  // An old one may stay beside its successor.
  material.client_authorities = expired.Pem() + authority_.Pem();
  EXPECT_THAT(CheckTlsMaterial(material, Now()), IsOk());
}

TEST_F(CertificatesTest, ClientCertificateTellsItsNamesByKind) {
  CertificateRequest request;
  request.common_name = "not looked at";
  request.alternative_names =
      "URI:spiffe://a/b,DNS:c.example,email:spiffe@a,IP:127.0.0.1,URI:x:y";
  const TestCertificate certificate(request, &authority_);
  const auto client = ReadClientCertificate(certificate.Pem());
  ASSERT_THAT(client, IsOk());
  EXPECT_THAT(client->uris, ElementsAre("spiffe://a/b", "x:y"));
  EXPECT_THAT(client->dns_names, ElementsAre("c.example"));
  EXPECT_LE(client->expires, request.until);
}

TEST_F(CertificatesTest, NamesOfClientsAreShortAndOfPrintableAscii) {
  CertificateRequest request;
  const std::string longest(kMaxCertificateNameBytes - 4, 'a');
  request.alternative_names = "URI:urn:" + longest + ",URI:urn:" + longest +
                              "a,URI:urn:caf\xc3\xa9,DNS:a\x1b,URI:urn:b";
  const TestCertificate certificate(request, &authority_);
  const auto client = ReadClientCertificate(certificate.Pem());
  ASSERT_THAT(client, IsOk());
  EXPECT_THAT(client->uris, ElementsAre("urn:" + longest, "urn:b"));
  EXPECT_THAT(client->dns_names, IsEmpty());
}

TEST_F(CertificatesTest, ClientCertificateMayHaveNoNames) {
  const auto client = ReadClientCertificate(leaf_.Pem());
  ASSERT_THAT(client, IsOk());
  EXPECT_THAT(client->uris, IsEmpty());
  EXPECT_THAT(client->dns_names, IsEmpty());
  EXPECT_EQ(ReadClientCertificate("garbage").status().code(),
            StatusCode::kInvalidArgument);
}

TEST(CheckClientAuthorityTest, AsksWhoIsTrustedNow) {
  CertificateRequest authority;
  authority.is_authority = true;
  authority.common_name = "root";
  const TestCertificate root(authority);
  authority.common_name = "between";
  const TestCertificate between(authority, &root);
  authority.common_name = "other";
  const TestCertificate other(authority);
  CertificateRequest request;
  request.alternative_names = "URI:urn:bus";
  const TestCertificate direct(request, &root);
  const TestCertificate indirect(request, &between);

  EXPECT_TRUE(CheckClientAuthority(direct.Pem(), "", root.Pem()).ok());
  EXPECT_TRUE(
      CheckClientAuthority(direct.Pem(), "", other.Pem() + root.Pem()).ok());
  EXPECT_FALSE(CheckClientAuthority(direct.Pem(), "", other.Pem()).ok());
  EXPECT_TRUE(
      CheckClientAuthority(indirect.Pem(), between.Pem(), root.Pem()).ok());
  EXPECT_TRUE(CheckClientAuthority(indirect.Pem(), "", between.Pem()).ok());
  EXPECT_FALSE(CheckClientAuthority(indirect.Pem(), "", root.Pem()).ok());
  EXPECT_FALSE(
      CheckClientAuthority(indirect.Pem(), between.Pem(), other.Pem()).ok());
  EXPECT_FALSE(CheckClientAuthority("rubbish", "", root.Pem()).ok());
}

}  // namespace
}  // namespace revisit::server
