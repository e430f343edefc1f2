#include "server/security/certificates.h"

#include <openssl/asn1.h>
#include <openssl/err.h>
#include <openssl/pem.h>

#include <algorithm>
#include <cstddef>
#include <ctime>
#include <utility>

#include "absl/strings/ascii.h"
#include "core/base/openssl_pointers.h"

namespace revisit::server {
namespace {

absl::Status Problem(const std::string& what) {
  ERR_clear_error();
  return absl::InvalidArgumentError(what.c_str());
}

// INVALID_ARGUMENT with OpenSSL's own words for its last error.
absl::Status ProblemWithReason(const std::string& what) {
  const unsigned long code = ERR_peek_last_error();
  const char* const reason =
      code == 0 ? nullptr : ERR_reason_error_string(code);
  return Problem(reason == nullptr ? what : what + ": " + reason);
}

std::size_t Count(const std::string& text, const std::string& word) {
  std::size_t count = 0;
  for (std::size_t at = text.find(word); at != std::string::npos;
       at = text.find(word, at + word.size())) {
    ++count;
  }
  return count;
}

bool IsReadableName(const std::string& name) {
  return name.size() <= kMaxCertificateNameBytes &&
         std::all_of(name.begin(), name.end(),
                     [](char c) { return absl::ascii_isprint(c); });
}

// Whether the last line that is not empty ends a block.
bool EndsWhole(const std::string& pem) {
  const std::size_t last = pem.find_last_not_of(" \t\r\n");
  if (last == std::string::npos) return false;
  const std::size_t line = pem.find_last_of('\n', last);
  return pem.compare(line == std::string::npos ? 0 : line + 1, 9,
                     "-----END ") == 0;
}

absl::StatusOr<std::vector<openssl::Certificate>> ReadCertificates(
    const std::string& pem, const std::string& what) {
  std::vector<openssl::Certificate> certificates;
  const openssl::Bio bio = openssl::Memory(pem);
  while (true) {
    openssl::Certificate certificate = openssl::ReadCertificate(bio);
    if (certificate == nullptr) break;
    certificates.push_back(std::move(certificate));
  }
  // The reader passes over what it does not understand at the end of a file,
  // which is what a file that is half written looks like.
  const unsigned long error = ERR_peek_last_error();
  const bool at_end = ERR_GET_LIB(error) == ERR_LIB_PEM &&
                      ERR_GET_REASON(error) == PEM_R_NO_START_LINE;
  if (!at_end) return ProblemWithReason(what + " cannot be read");
  if (certificates.empty()) return Problem(what + " holds no certificate");
  if (Count(pem, "-----BEGIN ") != certificates.size() || !EndsWhole(pem)) {
    return Problem(what + " is cut short, or holds more than certificates");
  }
  ERR_clear_error();
  return certificates;
}

CertificateTime TimeOf(const ASN1_TIME* time) {
  std::tm parts{};
  if (ASN1_TIME_to_tm(time, &parts) != 1) return CertificateTime::min();
  // The clock counts nanoseconds, which end in 2262.
  if (parts.tm_year > 340) return CertificateTime::max();
  return std::chrono::system_clock::from_time_t(timegm(&parts));
}

std::string Day(CertificateTime time) {
  const std::time_t seconds = std::chrono::system_clock::to_time_t(time);
  std::tm parts{};
  gmtime_r(&seconds, &parts);
  char text[32];
  std::strftime(text, sizeof(text), "%Y-%m-%dT%H:%M:%SZ", &parts);
  return text;
}

absl::Status CheckTime(X509* certificate, const std::string& what,
                       CertificateTime now) {
  const CertificateTime from = TimeOf(X509_get0_notBefore(certificate));
  const CertificateTime until = TimeOf(X509_get0_notAfter(certificate));
  if (now < from) return Problem(what + " is not valid before " + Day(from));
  if (now >= until) return Problem(what + " has expired at " + Day(until));
  return absl::OkStatus();
}

std::string SerialNumber(X509* certificate) {
  const openssl::BigNumber number(
      ASN1_INTEGER_to_BN(X509_get0_serialNumber(certificate), nullptr));
  char* const text = number == nullptr ? nullptr : BN_bn2hex(number.get());
  if (text == nullptr) return "";
  std::string serial = text;
  OPENSSL_free(text);
  return serial;
}

// Loads everything into a TLS context, as a listener would.
absl::Status TryListening(const std::vector<openssl::Certificate>& chain,
                          EVP_PKEY* key) {
  const openssl::Context context(SSL_CTX_new(TLS_server_method()));
  if (context == nullptr) return ProblemWithReason("cannot set up TLS");
  if (SSL_CTX_use_certificate(context.get(), chain.front().get()) != 1) {
    return ProblemWithReason("the certificate is not taken");
  }
  for (std::size_t i = 1; i < chain.size(); ++i) {
    if (SSL_CTX_add1_chain_cert(context.get(), chain[i].get()) != 1) {
      return ProblemWithReason("certificate " + std::to_string(i + 1) +
                               " of the chain is not taken");
    }
  }
  if (SSL_CTX_use_PrivateKey(context.get(), key) != 1 ||
      SSL_CTX_check_private_key(context.get()) != 1) {
    return ProblemWithReason("the private key is not taken");
  }
  return absl::OkStatus();
}

absl::Status CheckAuthorities(const std::string& pem, CertificateTime now) {
  const auto authorities =
      ReadCertificates(pem, "the file of client authorities");
  if (!authorities.ok()) return authorities.status();
  absl::Status none_valid;
  bool any_valid = false;
  for (std::size_t i = 0; i < authorities->size(); ++i) {
    const std::string what = "client authority " + std::to_string(i + 1);
    X509* const authority = (*authorities)[i].get();
    if (X509_check_ca(authority) == 0) {
      return Problem(what + " is no certificate authority");
    }
    absl::Status status = CheckTime(authority, what, now);
    any_valid = any_valid || status.ok();
    if (none_valid.ok()) none_valid = std::move(status);
  }
  return any_valid ? absl::OkStatus() : none_valid;
}

}  // namespace

absl::StatusOr<TlsSummary> CheckTlsMaterial(const TlsMaterial& material,
                                            CertificateTime now) {
  ERR_clear_error();
  const auto chain =
      ReadCertificates(material.certificate_chain, "the file of certificates");
  if (!chain.ok()) return chain.status();
  const openssl::Key key =
      openssl::ReadPrivateKey(openssl::Memory(material.private_key));
  if (key == nullptr) {
    return ProblemWithReason(
        "the private key cannot be read (it must not be encrypted)");
  }
  if (X509_check_private_key(chain->front().get(), key.get()) != 1) {
    return Problem("the private key is not that of the certificate");
  }
  for (std::size_t i = 0; i < chain->size(); ++i) {
    const std::string what =
        i == 0 ? std::string("the certificate")
               : "certificate " + std::to_string(i + 1) + " of the chain";
    if (absl::Status status = CheckTime((*chain)[i].get(), what, now);
        !status.ok()) {
      return status;
    }
    if (i > 0 && X509_check_issued((*chain)[i].get(), (*chain)[i - 1].get()) !=
                     X509_V_OK) {
      return Problem(what + " did not issue the one before it");
    }
  }
  if (absl::Status status = TryListening(*chain, key.get()); !status.ok()) {
    return status;
  }
  if (!material.client_authorities.empty()) {
    if (absl::Status status =
            CheckAuthorities(material.client_authorities, now);
        !status.ok()) {
      return status;
    }
  }
  return TlsSummary{TimeOf(X509_get0_notAfter(chain->front().get())),
                    SerialNumber(chain->front().get())};
}

absl::StatusOr<ClientCertificate> ReadClientCertificate(
    const std::string& pem) {
  ERR_clear_error();
  const openssl::Certificate certificate =
      openssl::ReadCertificate(openssl::Memory(pem));
  if (certificate == nullptr) {
    return ProblemWithReason("the client certificate cannot be read");
  }
  ClientCertificate client;
  client.expires = TimeOf(X509_get0_notAfter(certificate.get()));
  const openssl::GeneralNames names(
      static_cast<GENERAL_NAMES*>(X509_get_ext_d2i(
          certificate.get(), NID_subject_alt_name, nullptr, nullptr)));
  const int count = names == nullptr ? 0 : sk_GENERAL_NAME_num(names.get());
  for (int i = 0; i < count; ++i) {
    const GENERAL_NAME* name = sk_GENERAL_NAME_value(names.get(), i);
    std::vector<std::string>* list = name->type == GEN_URI   ? &client.uris
                                     : name->type == GEN_DNS ? &client.dns_names
                                                             : nullptr;
    if (list == nullptr) continue;
    const ASN1_IA5STRING* text = name->d.ia5;
    std::string value(
        reinterpret_cast<const char*>(ASN1_STRING_get0_data(text)),
        static_cast<std::size_t>(ASN1_STRING_length(text)));
    // A name with a NUL, for one, would be read differently by two readers.
    if (IsReadableName(value)) list->push_back(std::move(value));
  }
  ERR_clear_error();
  return client;
}

absl::Status CheckClientAuthority(const std::string& pem,
                                  const std::string& chain,
                                  const std::string& authorities) {
  ERR_clear_error();
  const openssl::Certificate certificate =
      openssl::ReadCertificate(openssl::Memory(pem));
  const openssl::Store store(X509_STORE_new());
  const openssl::StoreContext context(X509_STORE_CTX_new());
  const openssl::CertificateStack between(sk_X509_new_null());
  if (certificate == nullptr || store == nullptr || context == nullptr ||
      between == nullptr) {
    return ProblemWithReason("the client certificate cannot be read");
  }
  const openssl::Bio trusted = openssl::Memory(authorities);
  while (const openssl::Certificate one = openssl::ReadCertificate(trusted)) {
    X509_STORE_add_cert(store.get(), one.get());
  }
  // An authority that is listed is trusted, whoever issued it.
  X509_STORE_set_flags(store.get(), X509_V_FLAG_PARTIAL_CHAIN);
  const openssl::Bio shown = openssl::Memory(chain);
  while (openssl::Certificate one = openssl::ReadCertificate(shown)) {
    // Once pushed, the stack owns it.
    if (sk_X509_push(between.get(), one.get()) > 0) {
      static_cast<void>(one.release());
    }
  }
  if (X509_STORE_CTX_init(context.get(), store.get(), certificate.get(),
                          between.get()) != 1) {
    return ProblemWithReason("the client certificate cannot be verified");
  }
  const bool verified = X509_verify_cert(context.get()) == 1;
  const int error = X509_STORE_CTX_get_error(context.get());
  ERR_clear_error();
  if (verified) return absl::OkStatus();
  return Problem(X509_verify_cert_error_string(error));
}

}  // namespace revisit::server
