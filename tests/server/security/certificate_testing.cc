#include "tests/server/security/certificate_testing.h"

#include <openssl/ec.h>
#include <openssl/pem.h>
#include <openssl/rsa.h>

#include <atomic>
#include <cstddef>

namespace revisit::server {
namespace {

std::string TextOf(BIO* bio) {
  char* text = nullptr;
  const long size = BIO_get_mem_data(bio, &text);
  return std::string(text, static_cast<std::size_t>(size));
}

void AddExtension(X509* certificate, X509* issuer, int nid,
                  const std::string& value) {
  X509V3_CTX context;
  X509V3_set_ctx(&context, issuer, certificate, nullptr, nullptr, 0);
  X509_EXTENSION* const extension =
      X509V3_EXT_conf_nid(nullptr, &context, nid, value.c_str());
  X509_add_ext(certificate, extension, -1);
  X509_EXTENSION_free(extension);
}

}  // namespace

TestCertificate::TestCertificate(const CertificateRequest& request,
                                 const TestCertificate* issuer)
    : key_(request.rsa_bits > 0
               ? EVP_RSA_gen(static_cast<unsigned>(request.rsa_bits))
               : EVP_EC_gen("P-256")),
      certificate_(X509_new()) {
  static std::atomic<long> serial{1};
  X509* const made = certificate_.get();
  X509* const by = issuer == nullptr ? made : issuer->certificate_.get();
  X509_set_version(made, X509_VERSION_3);
  ASN1_INTEGER_set(X509_get_serialNumber(made), serial++);
  ASN1_TIME_set(X509_getm_notBefore(made),
                std::chrono::system_clock::to_time_t(request.from));
  ASN1_TIME_set(X509_getm_notAfter(made),
                std::chrono::system_clock::to_time_t(request.until));
  X509_set_pubkey(made, key_.get());
  X509_NAME_add_entry_by_txt(
      X509_get_subject_name(made), "CN", MBSTRING_ASC,
      reinterpret_cast<const unsigned char*>(request.common_name.c_str()), -1,
      -1, 0);
  X509_set_issuer_name(made, X509_get_subject_name(by));
  AddExtension(made, by, NID_basic_constraints,
               request.is_authority ? "critical,CA:TRUE" : "critical,CA:FALSE");
  if (!request.alternative_names.empty()) {
    AddExtension(made, by, NID_subject_alt_name, request.alternative_names);
  }
  X509_sign(made, issuer == nullptr ? key_.get() : issuer->key_.get(),
            EVP_sha256());
}

std::string TestCertificate::Pem() const {
  const openssl::Bio bio(BIO_new(BIO_s_mem()));
  PEM_write_bio_X509(bio.get(), certificate_.get());
  return TextOf(bio.get());
}

std::string TestCertificate::KeyPem() const {
  const openssl::Bio bio(BIO_new(BIO_s_mem()));
  PEM_write_bio_PrivateKey(bio.get(), key_.get(), nullptr, nullptr, 0, nullptr,
                           nullptr);
  return TextOf(bio.get());
}

}  // namespace revisit::server
