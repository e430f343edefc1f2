"""Certificates and bearer tokens, good ones and others."""

import base64
import datetime
import ipaddress
import json
import time

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import (
    ec, ed25519, padding, rsa, utils)
from cryptography.x509.oid import NameOID

ISSUER = "https://login.example"
AUDIENCE = "revisit"


def replace(path, content):
    """Writes a file in one step, as one that is in use is to be replaced."""
    if isinstance(content, str):
        content = content.encode()
    fresh = path.with_name(path.name + ".new")
    fresh.write_bytes(content)
    fresh.rename(path)
    return path


def _name(common_name):
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _pem(key):
    return key.private_bytes(serialization.Encoding.PEM,
                             serialization.PrivateFormat.PKCS8,
                             serialization.NoEncryption())


class Certificate:
    """A certificate with its key, in PEM."""

    def __init__(self, certificate, key):
        self.pem = certificate.public_bytes(serialization.Encoding.PEM)
        self.key_pem = _pem(key)
        self.serial = certificate.serial_number


_ALL_USAGES = ("digital_signature", "content_commitment", "key_encipherment",
               "data_encipherment", "key_agreement", "key_cert_sign", "crl_sign",
               "encipher_only", "decipher_only")


def _key_usage(*usages):
    return x509.KeyUsage(**{usage: usage in usages for usage in _ALL_USAGES})


class Authority:
    """Its certificates have what RFC 5280 asks for, without which newer programs
    take none."""

    def __init__(self, common_name="Test authority"):
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = _name(common_name)
        now = datetime.datetime.now(datetime.timezone.utc)
        self._certificate = (
            x509.CertificateBuilder()
            .subject_name(self._name).issuer_name(self._name)
            .public_key(self._key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=1))
            .not_valid_after(now + datetime.timedelta(days=30))
            .add_extension(x509.BasicConstraints(ca=True, path_length=None),
                           critical=True)
            .add_extension(_key_usage("key_cert_sign", "crl_sign"),
                           critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(
                self._key.public_key()), critical=False)
            .sign(self._key, hashes.SHA256()))
        self.pem = self._certificate.public_bytes(serialization.Encoding.PEM)

    def issue(self, *names, common_name="somebody", begins=-3600,
              ends=30 * 86400):
        """With alternative names: URIs, DNS names or addresses. Times are in
        seconds from now."""
        key = ec.generate_private_key(ec.SECP256R1())
        now = datetime.datetime.now(datetime.timezone.utc)
        builder = (
            x509.CertificateBuilder()
            .subject_name(_name(common_name)).issuer_name(self._name)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now + datetime.timedelta(seconds=begins))
            .not_valid_after(now + datetime.timedelta(seconds=ends))
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(
                    self._key.public_key()), critical=False))
        alternatives = []
        for name in names:
            if isinstance(name, ipaddress.IPv4Address):
                alternatives.append(x509.IPAddress(name))
            elif ":" in name:
                alternatives.append(x509.UniformResourceIdentifier(name))
            else:
                alternatives.append(x509.DNSName(name))
        if alternatives:
            builder = builder.add_extension(
                x509.SubjectAlternativeName(alternatives), critical=False)
        return Certificate(builder.sign(self._key, hashes.SHA256()), key)

    def issue_for_server(self, **times):
        return self.issue("localhost", ipaddress.ip_address("127.0.0.1"),
                          common_name="server", **times)


def _base64url(data):
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


def _number(value):
    return _base64url(value.to_bytes((value.bit_length() + 7) // 8, "big"))


class TokenKey:
    """A key that tokens are signed with, for one algorithm."""

    def __init__(self, algorithm, key_id):
        self.algorithm = algorithm
        self.key_id = key_id
        self._key = {
            "RS256": lambda: rsa.generate_private_key(65537, 2048),
            "ES256": lambda: ec.generate_private_key(ec.SECP256R1()),
            "EdDSA": ed25519.Ed25519PrivateKey.generate,
        }[algorithm]()

    def jwk(self):
        public = self._key.public_key()
        jwk = {"kid": self.key_id, "use": "sig", "alg": self.algorithm}
        if self.algorithm == "RS256":
            numbers = public.public_numbers()
            jwk |= {"kty": "RSA", "n": _number(numbers.n),
                    "e": _number(numbers.e)}
        elif self.algorithm == "ES256":
            numbers = public.public_numbers()
            jwk |= {"kty": "EC", "crv": "P-256",
                    "x": _base64url(numbers.x.to_bytes(32, "big")),
                    "y": _base64url(numbers.y.to_bytes(32, "big"))}
        else:
            jwk |= {"kty": "OKP", "crv": "Ed25519",
                    "x": _base64url(public.public_bytes(
                        serialization.Encoding.Raw,
                        serialization.PublicFormat.Raw))}
        return jwk

    def _sign(self, message):
        if self.algorithm == "RS256":
            return self._key.sign(message, padding.PKCS1v15(), hashes.SHA256())
        if self.algorithm == "EdDSA":
            return self._key.sign(message)
        r, s = utils.decode_dss_signature(
            self._key.sign(message, ec.ECDSA(hashes.SHA256())))
        return r.to_bytes(32, "big") + s.to_bytes(32, "big")

    def token(self, subject="backend", lasts=3600.0, header=None, **claims):
        """A token for so many seconds from now; claims that are None are left
        out."""
        payload = {"iss": ISSUER, "aud": AUDIENCE, "sub": subject,
                   "exp": time.time() + lasts} | claims
        payload = {name: value for name, value in payload.items()
                   if value is not None}
        parts = [{"alg": self.algorithm, "kid": self.key_id} | (header or {}),
                 payload]
        message = ".".join(_base64url(json.dumps(part).encode())
                           for part in parts)
        return message + "." + _base64url(self._sign(message.encode()))


def key_set(*keys):
    return json.dumps({"keys": [key.jwk() for key in keys]})


def bearer(token):
    """Metadata of a call."""
    return (("authorization", "Bearer " + token),)
