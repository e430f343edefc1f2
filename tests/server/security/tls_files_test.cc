#include "server/security/tls_files.h"

#include <fstream>
#include <sstream>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"
#include "tests/server/security/certificate_testing.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using std::chrono::hours;
using ::testing::HasSubstr;

CertificateTime Now() { return std::chrono::system_clock::now(); }

class TlsFilesTest : public testing::Test {
 protected:
  void Put(const std::string& name, const std::string& text) {
    std::ofstream(directory_.File(name)) << text;
  }
  void Put(const TestCertificate& certificate) {
    Put("key", certificate.KeyPem());
    Put("cert", certificate.Pem());
  }
  absl::StatusOr<std::unique_ptr<TlsFiles>> Load(CertificateTime now = Now()) {
    return TlsFiles::Load({directory_.File("key"), directory_.File("cert"), ""},
                          &log_, now);
  }
  int LinesWith(const std::string& word) const {
    int count = 0;
    std::istringstream lines(stream_.str());
    for (std::string line; std::getline(lines, line);) {
      if (line.find(word) != std::string::npos) ++count;
    }
    return count;
  }

  TemporaryDirectory directory_;
  std::ostringstream stream_;
  Log log_{LogFormat::kText, LogLevel::kInfo, &stream_};
  const TestCertificate old_{CertificateRequest()};
  const TestCertificate new_{CertificateRequest()};
};

TEST_F(TlsFilesTest, FilesThatAreNoGoodAreRefusedAtTheStart) {
  EXPECT_THAT(Load().status().ToString(), HasSubstr("cannot read"));
  Put("key", old_.KeyPem());
  Put("cert", "garbage");
  EXPECT_EQ(Load().status().code(), StatusCode::kInvalidArgument);
}

TEST_F(TlsFilesTest, ReplacedFilesAreTakenOnceBothAreThere) {
  Put(old_);
  auto files = Load().value();
  EXPECT_EQ(files->current().material->certificate_chain, old_.Pem());
  EXPECT_EQ(files->current().version, 1);
  files->Look(Now());
  EXPECT_EQ(files->current().version, 1);
  Put("key", new_.KeyPem());
  files->Look(Now());
  EXPECT_EQ(files->current().version, 1);
  Put("cert", new_.Pem());
  files->Look(Now());
  EXPECT_EQ(files->current().version, 2);
  EXPECT_EQ(files->current().material->certificate_chain, new_.Pem());
  EXPECT_EQ(files->current().material->private_key, new_.KeyPem());
  EXPECT_EQ(LinesWith("tls_files_loaded"), 1);
}

TEST_F(TlsFilesTest, BadFilesLeaveTheOldOnesInUseAndAreToldOnceAChange) {
  Put(old_);
  auto files = Load().value();
  int refused = 0;
  for (const std::string& bad :
       {std::string("garbage"), std::string(), new_.Pem(),
        old_.Pem().substr(0, old_.Pem().size() / 2)}) {
    Put("cert", bad);
    for (int i = 0; i < 3; ++i) files->Look(Now());
    EXPECT_EQ(LinesWith("tls_files_refused"), ++refused) << bad;
    EXPECT_EQ(files->current().version, 1);
    EXPECT_EQ(files->current().material->certificate_chain, old_.Pem());
  }
  std::remove(directory_.File("cert").c_str());
  for (int i = 0; i < 3; ++i) files->Look(Now());
  EXPECT_EQ(LinesWith("tls_files_refused"), ++refused);
  EXPECT_EQ(files->current().version, 1);
  Put("cert", old_.Pem());
  files->Look(Now());
  EXPECT_EQ(LinesWith("tls_files_loaded"), 1);
}

TEST_F(TlsFilesTest, CertificateForLaterIsTakenWhenItsTimeComes) {
  Put(old_);
  auto files = Load().value();
  CertificateRequest request;
  request.from = Now() + hours(1);
  const TestCertificate later(request);
  Put(later);
  files->Look(Now());
  EXPECT_EQ(files->current().version, 1);
  files->Look(Now() + hours(2));
  EXPECT_EQ(files->current().version, 2);
  EXPECT_EQ(LinesWith("tls_files_refused"), 1);
}

TEST_F(TlsFilesTest, WarnsOnceADayOfACertificateThatExpiresWithin14Days) {
  CertificateRequest request;
  request.until = Now() + hours(20 * 24);
  const TestCertificate certificate(request);
  Put(certificate);
  const CertificateTime start = Now();
  auto files = Load(start).value();
  files->Look(start + hours(5 * 24));
  EXPECT_EQ(LinesWith("certificate_expires_soon"), 0);
  files->Look(start + hours(7 * 24));
  files->Look(start + hours(7 * 24 + 12));
  EXPECT_EQ(LinesWith("certificate_expires_soon"), 1);
  files->Look(start + hours(8 * 24 + 1));
  EXPECT_EQ(LinesWith("certificate_expires_soon"), 2);
}

}  // namespace
}  // namespace revisit::server
