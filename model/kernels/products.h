// Products of a few rows with a packed weight in vector registers.
#pragma once

#include "vectors.h"

namespace {

// What edges are multiplied in: bfloat16 where the processor has products of them with float32 sums.
#if defined(__AVX512BF16__)
typedef uint16_t element;
inline void put(element* to, vec v) {
  const __m256bh half = _mm512_cvtneps_pbh((__m512)v);
  std::memcpy(to, &half, sizeof half);
}
#else
typedef float element;
inline void put(element* to, vec v) { store(to, v); }
#endif

// W (out_width, width), so that a vector's channels lie beside each other.
inline void pack_floats(const float* weight, int width, int out_width, float* packed) {
  for (int c0 = 0; c0 < out_width; c0 += LANES)
    for (int d = 0; d < width; ++d)
      for (int lane = 0; lane < LANES; ++lane)
        packed[(size_t)c0 * width + (size_t)d * LANES + lane] = weight[(size_t)(c0 + lane) * width + d];
}

// sum[r][c] = row r of `rows` (ROWS, width) times the vector c of columns of `packed`, which pack or pack_linear wrote.
template <int ROWS, int COLS>
inline void products(const float* rows, int width, const float* packed, vec sum[ROWS][COLS]) {
  vec s[ROWS][COLS];
  for (int r = 0; r < ROWS; ++r)
    for (int c = 0; c < COLS; ++c) s[r][c] = vec{};
  for (int d = 0; d < width; ++d) {
    vec w[COLS];
    for (int c = 0; c < COLS; ++c) w[c] = load(packed + (size_t)c * LANES * width + (size_t)d * LANES);
    for (int r = 0; r < ROWS; ++r) {
      const vec h = splat(rows[(size_t)r * width + d]);
      for (int c = 0; c < COLS; ++c) s[r][c] += h * w[c];
    }
  }
  for (int r = 0; r < ROWS; ++r)
    for (int c = 0; c < COLS; ++c) sum[r][c] = s[r][c];
}

#if defined(__AVX512BF16__)
template <int ROWS, int COLS>
inline void products(const uint16_t* rows, int width, const uint16_t* packed, vec sum[ROWS][COLS]) {
  __m512 s[ROWS][COLS];
  for (int r = 0; r < ROWS; ++r)
    for (int c = 0; c < COLS; ++c) s[r][c] = _mm512_setzero_ps();
  for (int d = 0; d < width; d += 2) {
    __m512bh w[COLS];
    for (int c = 0; c < COLS; ++c)
      w[c] = (__m512bh)_mm512_loadu_si512(packed + (size_t)c * LANES * width + (size_t)d * LANES);
    for (int r = 0; r < ROWS; ++r) {
      int32_t pair;
      std::memcpy(&pair, rows + (size_t)r * width + d, 4);
      const __m512bh h = (__m512bh)_mm512_set1_epi32(pair);
      for (int c = 0; c < COLS; ++c) s[r][c] = _mm512_dpbf16_ps(s[r][c], h, w[c]);
    }
  }
  for (int r = 0; r < ROWS; ++r)
    for (int c = 0; c < COLS; ++c) sum[r][c] = (vec)s[r][c];
}
#endif

}  // namespace
