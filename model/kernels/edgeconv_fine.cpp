// The EdgeConv maximum for inference in products of 16-bit integers with 32-bit sums, where there are none of bfloat16:
// every x86 makes twice as many of them in an instruction as of float32. What is added to an edge, the point's share and
// its neighbour's, is rounded to steps of one size for the patch, so that an edge is made, and the largest sum found,
// without leaving the integers. On AMX's tiles, with AVX-512, where additions take what the products leave, and on other
// processors it is straightpcf_edge_max.

#include "kernels.h"
#include "vectors.h"

#if defined(__SSE2__) && !defined(__AVX512F__)

#include <cmath>

namespace {

constexpr float LARGEST = 32767.0f;       // of a share and of a weight
constexpr float LARGEST_EDGE = 16383.0f;  // what is left of 32 bits is the weights'
constexpr int PAIR = 2;                   // products that a lane sums in one instruction
constexpr int SHORTS = PAIR * LANES;      // in a register
typedef int16_t shorts __attribute__((vector_size(2 * SHORTS), aligned(2), may_alias));

// sum + edge times weight, two products to a lane; and 2 * LANES numbers, rounded, as 16 bits.
#if defined(__AVX2__)
inline ivec add_products(ivec sum, ivec edge, ivec weight) {
  return sum + (ivec)_mm256_madd_epi16((__m256i)edge, (__m256i)weight);
}
inline shorts rounded(vec low, vec high) {
  const __m256i halves = _mm256_packs_epi32(_mm256_cvtps_epi32((__m256)low), _mm256_cvtps_epi32((__m256)high));
  return (shorts)_mm256_permute4x64_epi64(halves, 0xd8);
}
inline shorts edge_of(shorts a, shorts b) {
  return (shorts)_mm256_max_epi16(_mm256_adds_epi16((__m256i)a, (__m256i)b), _mm256_setzero_si256());
}
#else
inline ivec add_products(ivec sum, ivec edge, ivec weight) {
  return sum + (ivec)_mm_madd_epi16((__m128i)edge, (__m128i)weight);
}
inline shorts rounded(vec low, vec high) {
  return (shorts)_mm_packs_epi32(_mm_cvtps_epi32((__m128)low), _mm_cvtps_epi32((__m128)high));
}
inline shorts edge_of(shorts a, shorts b) {
  return (shorts)_mm_max_epi16(_mm_adds_epi16((__m128i)a, (__m128i)b), _mm_setzero_si128());
}
#endif

inline shorts load(const int16_t* p) { return *reinterpret_cast<const shorts*>(p); }

inline void round_rows(const float* from, int rows, int width, float scale, int16_t* to) {
  for (size_t n = 0; n < (size_t)rows * width; n += SHORTS)
    *reinterpret_cast<shorts*>(to + n) = rounded(load(from + n) * scale, load(from + n + LANES) * scale);
}

// The largest number of each channel, to `most`.
inline void largest_of(const float* x, int rows, int width, float* most) {
  for (int d = 0; d < width; d += LANES) {
    vec largest = load(x + d);
    for (int i = 1; i < rows; ++i) {
      const vec v = load(x + (size_t)i * width + d);
      largest = v > largest ? v : largest;
    }
    store(most + d, largest);
  }
}

// How many steps there are to 1: no share and no edge has more of them than it may. What is farther below zero than 16
// bits reach is cut off there, and with no other share is above it.
inline float scale_of(const float* a, int rows, const float* b, int count, int width) {
  std::vector<float> own(width), others(width);
  largest_of(a, rows, width, own.data());
  largest_of(b, count, width, others.data());
  float step = 0;
  for (int d = 0; d < width; ++d)  // two roundings make one step more
    step = std::max({step, std::max(own[d], others[d]) / LARGEST, (own[d] + others[d]) / (LARGEST_EDGE - 1)});
  return step > 0 ? 1 / step : 0;
}

// One block of R edges by C vectors of channels: products with the packed weight, then the running maximum.
template <int R, int C>
inline void block(const int16_t* edges, int width, const int16_t* packed, ivec* best) {
  ivec s[R][C];
  for (int r = 0; r < R; ++r)
    for (int c = 0; c < C; ++c) s[r][c] = ivec{};
  for (int d = 0; d < width; d += PAIR) {
    ivec w[C];
    for (int c = 0; c < C; ++c)
      w[c] = load(reinterpret_cast<const int32_t*>(packed + (size_t)c * LANES * width + (size_t)d * LANES));
    for (int r = 0; r < R; ++r) {
      int32_t pair;
      std::memcpy(&pair, edges + (size_t)r * width + d, sizeof pair);
      for (int c = 0; c < C; ++c) s[r][c] = add_products(s[r][c], ivec{} + pair, w[c]);
    }
  }
  for (int c = 0; c < C; ++c)
    for (int r = 0; r < R; ++r) best[c] = s[r][c] > best[c] ? s[r][c] : best[c];
}

}  // namespace

extern "C" {

// W (out_width, width), both multiples of 32 -> packed for edge_max_fine. Size: width * out_width floats.
void straightpcf_pack_fine(const float* weight, int width, int out_width, float* packed) {
  int16_t* whole = reinterpret_cast<int16_t*>(packed);
  float* steps = reinterpret_cast<float*>(whole + (size_t)width * out_width);  // how large those of each row are
  for (int c = 0; c < out_width; ++c) {
    const float* row = weight + (size_t)c * width;
    float largest = 0, up = 0, down = 0;
    for (int d = 0; d < width; ++d) {
      largest = std::max(largest, std::fabs(row[d]));
      (row[d] > 0 ? up : down) += std::fabs(row[d]);
    }
    // No sum of edges times weights, each half a step larger than it was, has more than 32 bits.
    const float most = float(INT32_MAX) / LARGEST_EDGE - width;
    const float step = std::max(largest / LARGEST, std::max(up, down) / most), scale = step > 0 ? 1 / step : 0;
    int16_t* column = whole + (size_t)(c / LANES) * LANES * width + (c % LANES) * PAIR;
    for (int d = 0; d < width; ++d)
      column[(size_t)(d / PAIR) * LANES * PAIR + d % PAIR] = int16_t(std::nearbyint(row[d] * scale));
    steps[c] = step;
  }
}

// As straightpcf_edge_max, without the winning edges; b has `count` rows.
void straightpcf_edge_max_fine(const float* a, const float* b, const int32_t* index, const float* packed, int rows,
                               int count, int k, int width, int out_width, float* out) {
  std::vector<int16_t> scratch((size_t)(count + k + 1) * width + 32);  // a cache line more, to begin at one
  int16_t *others = aligned(scratch.data()), *edges = others + (size_t)count * width, *own = edges + (size_t)k * width;
  const float scale = scale_of(a, rows, b, count, width), step = scale > 0 ? 1 / scale : 0;
  const int16_t* whole = reinterpret_cast<const int16_t*>(packed);
  const float* steps = reinterpret_cast<const float*>(whole + (size_t)width * out_width);
  round_rows(b, count, width, scale, others);
  for (int i = 0; i < rows; ++i) {
    round_rows(a + (size_t)i * width, 1, width, scale, own);
    for (int n = 0; n < k; ++n) {
      const int16_t* other = others + (size_t)index[(size_t)i * k + n] * width;
      int16_t* edge = edges + (size_t)n * width;
      for (int d = 0; d < width; d += SHORTS)
        *reinterpret_cast<shorts*>(edge + d) = edge_of(load(own + d), load(other + d));
    }
    for (int c0 = 0; c0 < out_width; c0 += COLS * LANES) {
      ivec best[COLS];
      for (int c = 0; c < COLS; ++c) best[c] = ivec{} + INT32_MIN;
      const int16_t* w = whole + (size_t)c0 * width;
      int n = 0;
      for (; n + ROWS <= k; n += ROWS) block<ROWS, COLS>(edges + (size_t)n * width, width, w, best);
      for (; n < k; ++n) block<1, COLS>(edges + (size_t)n * width, width, w, best);
      for (int c = 0; c < COLS; ++c)
        store(out + (size_t)i * out_width + c0 + c * LANES,
              __builtin_convertvector(best[c], vec) * step * load(steps + c0 + c * LANES));
    }
  }
}

}  // extern "C"

#else

extern "C" {

void straightpcf_pack_fine(const float* weight, int width, int out_width, float* packed) {
  straightpcf_pack(weight, width, out_width, packed);
}

void straightpcf_edge_max_fine(const float* a, const float* b, const int32_t* index, const float* packed, int rows,
                               int, int k, int width, int out_width, float* out) {
  straightpcf_edge_max(a, b, index, packed, rows, k, width, out_width, out, nullptr);
}

}  // extern "C"

#endif
