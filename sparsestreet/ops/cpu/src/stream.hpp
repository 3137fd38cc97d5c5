// Tables of a step are larger than the caches that a thread has for itself. A store first reads the line that it will
// fill; one past the caches does not: a third of what filling a table moves.
#pragma once
#include <cstring>

#include "lanes.hpp"

namespace SPLAT_VARIANT {

constexpr int64_t STREAM_BYTES = 1024;  // below it the unaligned ends cost more than they save

#if defined(__AVX512F__)
inline void stream_register(char* to, const char* from) {
  _mm512_stream_si512(reinterpret_cast<__m512i*>(to), _mm512_loadu_si512(from));
}
#elif defined(__AVX2__)
inline void stream_register(char* to, const char* from) {
  _mm256_stream_si256(reinterpret_cast<__m256i*>(to), _mm256_loadu_si256(reinterpret_cast<const __m256i*>(from)));
}
#endif

// Past the caches: std::memcpy, or with `from` null std::memset to 0. Visible to other threads after `end_stream`.
template <class T>
inline void stream(T* to, const T* from, int64_t count) {
  char* out = reinterpret_cast<char*>(to);
  const char* in = reinterpret_cast<const char*>(from);
  int64_t bytes = count * int64_t(sizeof(T));
  const auto plainly = [&](int64_t n) {
    if (in) std::memcpy(out, in, n), in += n;
    else std::memset(out, 0, n);
    out += n, bytes -= n;
  };
#if defined(__AVX2__)
  if (bytes >= STREAM_BYTES) {
    static constexpr char zeros[REGISTER_BYTES] = {};
    plainly(-reinterpret_cast<intptr_t>(out) & (REGISTER_BYTES - 1));
    for (; bytes >= REGISTER_BYTES; bytes -= REGISTER_BYTES, out += REGISTER_BYTES) {
      stream_register(out, in ? in : zeros);
      if (in) in += REGISTER_BYTES;
    }
  }
#endif
  plainly(bytes);
}

inline void end_stream() {
#if defined(__AVX2__)
  _mm_sfence();
#endif
}

}  // namespace SPLAT_VARIANT
