// CRC-32 and SHA-256 against published values.
#include <string>
#include <vector>

#include "base/bytes.h"
#include "check.h"

namespace {
std::span<const std::byte> bytes(const std::string& s) {
  return std::as_bytes(std::span(s.data(), s.size()));
}
}  // namespace

int main() {
  using protomark::crc32;
  using protomark::sha256;
  // The check value of the CRC catalogue (CRC-32/ISO-HDLC).
  CHECK(crc32(bytes("123456789")) == 0xcbf43926u);
  CHECK(crc32(bytes("")) == 0);
  CHECK(crc32(bytes("6789"), crc32(bytes("12345"))) == 0xcbf43926u);
  CHECK(crc32(bytes(std::string(1000, 'a'))) ==
        crc32(bytes(std::string(993, 'a')), crc32(bytes(std::string(7, 'a')))));
  // FIPS 180-4 examples.
  CHECK(sha256(bytes("")) == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
  CHECK(sha256(bytes("abc")) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
  CHECK(sha256(bytes("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq")) ==
        "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1");
  CHECK(sha256(bytes(std::string(1000000, 'a'))) ==
        "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0");
  return check::result();
}
