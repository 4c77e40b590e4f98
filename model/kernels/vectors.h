// What every kernel is written in: vectors of floats.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace {

// Floats of a vector, as many as a register has: gcc keeps wider ones in memory. And rows, and vectors of columns, of a
// block of sums that fits the registers beside what it is summed from.
#if defined(__AVX512F__)
constexpr int LANES = 16, ROWS = 8, COLS = 2;
#elif defined(__AVX2__)
constexpr int LANES = 8, ROWS = 4, COLS = 2;
#elif defined(__aarch64__)
constexpr int LANES = 4, ROWS = 8, COLS = 2;
#else
constexpr int LANES = 4, ROWS = 4, COLS = 2;
#endif
typedef float vec __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef int32_t ivec __attribute__((vector_size(4 * LANES), aligned(4), may_alias));

struct alignas(4 * LANES) Line { vec v; };  // never across two cache lines

// Not by memcpy, which gcc makes two halves of for AVX2, by way of the stack: five times as slow.
inline vec load(const float* p) { return *reinterpret_cast<const vec*>(p); }
inline ivec load(const int32_t* p) { return *reinterpret_cast<const ivec*>(p); }
inline void store(float* p, vec v) { *reinterpret_cast<vec*>(p) = v; }
template <typename T>
inline T* aligned(T* p) { return reinterpret_cast<T*>((reinterpret_cast<uintptr_t>(p) + 63) / 64 * 64); }  // to a line
inline vec splat(float x) { return vec{} + x; }
inline float largest_lane(vec v) {
  float lanes[LANES];
  store(lanes, v);
  for (int half = LANES / 2; half; half /= 2)
    for (int n = 0; n < half; ++n) lanes[n] = std::max(lanes[n], lanes[n + half]);
  return lanes[0];
}

inline int32_t bits_of(float x) { int32_t bits; std::memcpy(&bits, &x, 4); return bits; }
inline float float_of(int32_t bits) { float x; std::memcpy(&x, &bits, 4); return x; }

}  // namespace
