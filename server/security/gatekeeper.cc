#include "server/security/gatekeeper.h"

#include <openssl/evp.h>

#include <algorithm>
#include <cstddef>
#include <map>
#include <optional>
#include <thread>
#include <unordered_map>
#include <utility>

#include "absl/strings/ascii.h"
#include "core/base/mutex.h"
#include "server/base/status.h"
#include "server/security/certificates.h"
#include "server/security/policy.h"

namespace revisit::server {
namespace {

// Callers that are remembered, so that their credentials need not be verified
// again. More credentials than this would be a flood.
constexpr std::size_t kMaxRemembered = 10000;

absl::Status Unauthenticated(const char* reason, const std::string& what) {
  return Error(absl::StatusCode::kUnauthenticated, reason, what);
}

// A hash, so that what is remembered is small and no secret.
std::string Fingerprint(const std::string& credential) {
  std::string hash(EVP_MAX_MD_SIZE, '\0');
  std::size_t size = 0;
  EVP_Q_digest(nullptr, "SHA256", nullptr, credential.data(), credential.size(),
               reinterpret_cast<unsigned char*>(hash.data()), &size);
  hash.resize(size);
  return hash;
}

class OpenGatekeeper final : public Gatekeeper {
 public:
  bool asks() const override { return false; }
  absl::StatusOr<std::shared_ptr<const Caller>> Admit(const Credentials&,
                                                      Time) override {
    return everyone_;
  }
  WatchId Watch(Time, std::function<void()>) override { return -1; }
  void Unwatch(WatchId) override {}
  std::optional<FilesState> files() const override { return std::nullopt; }
  void LookAtFiles() override {}

 private:
  const std::shared_ptr<const Caller> everyone_ =
      std::make_shared<const Caller>();
};

// Keys and policy as the files had them at one time, and who was found by them.
// Thread-safe.
class Rules {
 public:
  Rules(std::optional<JwkSet> keys, Policy policy, TokenRules token_rules)
      : keys_(std::move(keys)),
        policy_(std::move(policy)),
        token_rules_(std::move(token_rules)) {}

  bool takes_tokens() const { return keys_.has_value(); }

  absl::StatusOr<std::shared_ptr<const Caller>> ByToken(
      const std::string& token, Gatekeeper::Time now) const {
    // Tokens and certificates share one map: no certificate is a token.
    const std::string fingerprint = Fingerprint(token);
    if (auto known = Recall(fingerprint)) {
      if (now < known->expires) return known;
    }
    const absl::StatusOr<Token> verified =
        VerifyToken(token, *keys_, token_rules_);
    if (!verified.ok()) return verified.status();
    if (absl::Status status = CheckTokenTime(*verified, now); !status.ok()) {
      return status;
    }
    Identity identity;
    identity.token_subject = verified->subject;
    identity.token_claims = verified->claims;
    return Find(fingerprint, identity, "token:" + verified->subject,
                verified->expires);
  }

  // `files` may be null.
  absl::StatusOr<std::shared_ptr<const Caller>> ByCertificate(
      const Credentials& credentials, const TlsFiles* files,
      Gatekeeper::Time now) const {
    const std::string& pem = credentials.certificate_pem;
    const TlsFiles::Current trusted =
        files == nullptr ? TlsFiles::Current() : files->current();
    // The authorities are part of the key: a caller is not remembered once they
    // have changed.
    const std::string fingerprint =
        Fingerprint(std::to_string(trusted.version) + pem +
                    credentials.certificate_chain_pem);
    if (auto known = Recall(fingerprint)) {
      if (now < known->expires) return known;
    }
    absl::StatusOr<ClientCertificate> certificate = ReadClientCertificate(pem);
    if (!certificate.ok()) {
      return Unauthenticated("CREDENTIALS_INVALID",
                             std::string(certificate.status().message()));
    }
    if (now >= certificate->expires) {
      return Unauthenticated(
          "CERTIFICATE_EXPIRED",
          "the client certificate has expired; connect with a new one");
    }
    if (trusted.material != nullptr) {
      const absl::Status status =
          CheckClientAuthority(pem, credentials.certificate_chain_pem,
                               trusted.material->client_authorities);
      if (!status.ok()) {
        return Unauthenticated(
            "CREDENTIALS_INVALID",
            "no authority that is trusted now stands behind the client "
            "certificate (" +
                std::string(status.message()) + "); connect with a new one");
      }
    }
    Identity identity;
    identity.certificate_uris = std::move(certificate->uris);
    identity.certificate_dns_names = std::move(certificate->dns_names);
    const std::string name = !identity.certificate_uris.empty()
                                 ? identity.certificate_uris.front()
                             : !identity.certificate_dns_names.empty()
                                 ? identity.certificate_dns_names.front()
                                 : "";
    if (name.empty()) {
      return Unauthenticated("CREDENTIALS_INVALID",
                             "the client certificate has no URI and no DNS "
                             "name among its alternative names");
    }
    return Find(fingerprint, identity, "certificate:" + name,
                certificate->expires);
  }

 private:
  std::shared_ptr<const Caller> Recall(const std::string& fingerprint) const {
    const MutexLock lock(&mutex_);
    const auto found = remembered_.find(fingerprint);
    return found == remembered_.end() ? nullptr : found->second;
  }

  absl::StatusOr<std::shared_ptr<const Caller>> Find(
      const std::string& fingerprint, const Identity& identity,
      std::string name, Gatekeeper::Time expires) const {
    auto caller = std::make_shared<Caller>();
    caller->identity = std::move(name);
    caller->expires = expires;
    if (absl::Status status = policy_.Apply(identity, caller.get());
        !status.ok()) {
      return status;
    }
    const MutexLock lock(&mutex_);
    if (remembered_.size() >= kMaxRemembered) remembered_.clear();
    remembered_[fingerprint] = caller;
    return std::shared_ptr<const Caller>(std::move(caller));
  }

  const std::optional<JwkSet> keys_;
  const Policy policy_;
  const TokenRules token_rules_;

  mutable Mutex mutex_;
  // Verified callers, by the fingerprint of their credential.
  mutable std::unordered_map<std::string, std::shared_ptr<const Caller>>
      remembered_ ABSL_GUARDED_BY(mutex_);
};

// The token of an `authorization` value; nullopt if it is no bearer token.
std::optional<std::string> BearerToken(const std::string& authorization) {
  constexpr std::size_t kSchemeBytes = 7;
  if (absl::AsciiStrToLower(authorization.substr(0, kSchemeBytes)) !=
      "bearer ") {
    return std::nullopt;
  }
  return authorization.substr(kSchemeBytes);
}

class FileGatekeeper final : public Gatekeeper {
 public:
  FileGatekeeper(const GatekeeperSettings& settings, const Log* log)
      : settings_(settings), log_(log), files_(Paths(settings)) {}

  ~FileGatekeeper() override {
    {
      const MutexLock lock(&mutex_);
      stopping_ = true;
    }
    wake_.NotifyAll();
    if (thread_.joinable()) thread_.join();
  }

  absl::Status Start() {
    files_.Look();
    if (absl::Status status = Take(); !status.ok()) return status;
    thread_ = std::thread([this] { Run(); });
    return absl::OkStatus();
  }

  bool asks() const override { return true; }

  absl::StatusOr<std::shared_ptr<const Caller>> Admit(
      const Credentials& credentials, Time now) override {
    const std::shared_ptr<const Rules> rules = CurrentRules();
    const auto& authorizations = credentials.authorizations;
    if (!authorizations.empty()) {
      if (!rules->takes_tokens()) {
        return Unauthenticated("CREDENTIALS_INVALID",
                               "this server takes no bearer tokens; callers "
                               "are known by their client certificates");
      }
      const auto token = authorizations.size() == 1
                             ? BearerToken(authorizations.front())
                             : std::nullopt;
      if (!token) {
        return Unauthenticated(
            "CREDENTIALS_INVALID",
            "`authorization` has to be given once, as \"Bearer TOKEN\"");
      }
      return rules->ByToken(*token, now);
    }
    if (settings_.takes_certificates && !credentials.certificate_pem.empty()) {
      return rules->ByCertificate(credentials, settings_.tls_files, now);
    }
    std::string needed;
    if (rules->takes_tokens()) {
      needed = "a bearer token in the metadata key `authorization`";
    }
    if (settings_.takes_certificates) {
      needed +=
          std::string(needed.empty() ? "" : " or ") + "a client certificate";
    }
    return Unauthenticated("CREDENTIALS_MISSING", "the call needs " + needed);
  }

  WatchId Watch(Time expires, std::function<void()> recheck) override {
    const MutexLock lock(&mutex_);
    const WatchId id = next_id_++;
    watches_[id] = {expires, std::move(recheck)};
    if (expires < wakes_at_) wake_.NotifyAll();
    return id;
  }

  void Unwatch(WatchId id) override {
    const MutexLock lock(&mutex_);
    watches_.erase(id);
  }

  std::optional<FilesState> files() const override {
    const MutexLock lock(&rules_mutex_);
    return state_;
  }

  void LookAtFiles() override {
    {
      const MutexLock lock(&mutex_);
      hastened_ = true;
    }
    wake_.NotifyAll();
  }

 private:
  struct Watched {
    Time expires;
    std::function<void()> recheck;
  };

  static std::vector<std::string> Paths(const GatekeeperSettings& settings) {
    std::vector<std::string> paths = {settings.policy_file};
    if (!settings.token_keys_file.empty()) {
      paths.push_back(settings.token_keys_file);
    }
    return paths;
  }

  std::shared_ptr<const Rules> CurrentRules() const {
    const MutexLock lock(&rules_mutex_);
    return rules_;
  }

  // Makes rules of the contents that the files had at the last look.
  absl::Status Take() {
    if (!files_.contents().ok()) return files_.contents().status();
    const std::vector<std::string>& texts = *files_.contents();
    absl::StatusOr<Policy> policy = Policy::Parse(texts[0]);
    if (!policy.ok()) {
      return absl::InvalidArgumentError((settings_.policy_file + ": " +
                                         std::string(policy.status().message()))
                                            .c_str());
    }
    std::optional<JwkSet> keys;
    if (texts.size() > 1) {
      absl::StatusOr<JwkSet> parsed = JwkSet::Parse(texts[1]);
      if (!parsed.ok()) {
        return absl::InvalidArgumentError(
            (settings_.token_keys_file + ": " +
             std::string(parsed.status().message()))
                .c_str());
      }
      keys = *std::move(parsed);
    }
    auto rules = std::make_shared<const Rules>(
        std::move(keys), *std::move(policy), settings_.token_rules);
    const MutexLock lock(&rules_mutex_);
    rules_ = std::move(rules);
    state_ = {std::chrono::system_clock::now(), /*refused=*/false};
    return absl::OkStatus();
  }

  void TakeChanges() ABSL_LOCKS_EXCLUDED(mutex_) {
    if (!files_.Look()) return;
    if (const absl::Status status = Take(); status.ok()) {
      log_->Write(LogLevel::kInfo, "access_rules_loaded", {});
    } else {
      log_->Write(LogLevel::kError, "access_rules_refused",
                  {{"message", std::string(status.message()) +
                                   "; what was loaded before stays in use"}});
      const MutexLock lock(&rules_mutex_);
      state_.refused = true;
    }
  }

  void Run() {
    auto next_check = std::chrono::steady_clock::now() + settings_.check_period;
    MutexLock lock(&mutex_);
    while (!stopping_) {
      // Times of expiry are those of the system's clock, which may jump: so it
      // sleeps no longer than to the next check.
      const auto now = std::chrono::system_clock::now();
      auto wait = next_check - std::chrono::steady_clock::now();
      for (const auto& [id, watch] : watches_) {
        wait = std::min<std::chrono::steady_clock::duration>(
            wait, std::max(watch.expires, now) - now);
      }
      wakes_at_ = now + wait;
      if (wait.count() > 0 && !hastened_) {
        wake_.WaitUntil(&mutex_, std::chrono::steady_clock::now() + wait);
      }
      if (stopping_) return;
      const bool check_all = std::exchange(hastened_, false) ||
                             std::chrono::steady_clock::now() >= next_check;
      if (check_all) {
        lock.Unlock();
        TakeChanges();
        lock.Lock();
        next_check = std::chrono::steady_clock::now() + settings_.check_period;
      }
      std::vector<std::function<void()>> due;
      for (auto& [id, watch] : watches_) {
        const bool expired = watch.expires <= std::chrono::system_clock::now();
        if (check_all || expired) due.push_back(watch.recheck);
        // One call is enough: expired credentials stay expired.
        if (expired) watch.expires = Time::max();
      }
      // Called without the lock: callbacks may call Unwatch().
      lock.Unlock();
      for (const auto& recheck : due) recheck();
      due.clear();
      lock.Lock();
    }
  }

  const GatekeeperSettings settings_;
  const Log* const log_;
  // Used by Start(), then by the thread alone.
  WatchedFiles files_;

  mutable Mutex rules_mutex_;
  std::shared_ptr<const Rules> rules_ ABSL_GUARDED_BY(rules_mutex_);
  FilesState state_ ABSL_GUARDED_BY(rules_mutex_);

  Mutex mutex_;
  CondVar wake_;
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  // Whether LookAtFiles() was called and the thread has not looked since.
  bool hastened_ ABSL_GUARDED_BY(mutex_) = false;
  WatchId next_id_ ABSL_GUARDED_BY(mutex_) = 0;
  std::map<WatchId, Watched> watches_ ABSL_GUARDED_BY(mutex_);
  Time wakes_at_ ABSL_GUARDED_BY(mutex_) = Time::max();

  // Declared last: it uses the other members.
  std::thread thread_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<Gatekeeper>> StartGatekeeper(
    const GatekeeperSettings& settings, const Log* log) {
  auto gatekeeper = std::make_unique<FileGatekeeper>(settings, log);
  if (absl::Status status = gatekeeper->Start(); !status.ok()) return status;
  return std::unique_ptr<Gatekeeper>(std::move(gatekeeper));
}

std::unique_ptr<Gatekeeper> MakeOpenGatekeeper() {
  return std::make_unique<OpenGatekeeper>();
}

}  // namespace revisit::server
