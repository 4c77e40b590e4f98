// The EdgeConv maximum in products of small integers with 32-bit sums. For inference, and for block 3 alone: no graph of
// neighbours is taken from its output. What ReLU leaves of an edge is rounded to steps, so many up to that edge's
// largest, and a row of the weight likewise. Of bytes (VNNI, or ARM's dot product) an instruction makes four times as
// many products as of float32; of 16 bits, which every x86 has, twice as many. On AMX's tiles, in AVX-512 without VNNI,
// where 16 bits gain nothing, and on other processors it is straightpcf_edge_max.

#include "kernels.h"
#include "vectors.h"

#if defined(__ARM_FEATURE_DOTPROD)
#include <arm_neon.h>
#endif

#if defined(__AVX512VNNI__) || defined(__ARM_FEATURE_DOTPROD) || (defined(__SSE2__) && !defined(__AVX512F__))

#include <cmath>

namespace {

// An edge's numbers go from -ZERO to LARGEST_EDGE - ZERO. ARM's bytes have a sign on both sides, so that an edge's zero
// lies there. A row of the weight goes up to LARGEST_WEIGHT, and its sum so far that no sum of products is over 32 bits.
#if defined(__AVX512VNNI__) || defined(__AVXVNNI__) || defined(__ARM_FEATURE_DOTPROD)
typedef int8_t integer;
constexpr float LARGEST_EDGE = 255.0f, LARGEST_WEIGHT = 127.0f;
#else
typedef int16_t integer;
constexpr float LARGEST_EDGE = 8191.0f, LARGEST_WEIGHT = 32767.0f;
#endif
constexpr int PER_LANE = sizeof(int32_t) / sizeof(integer);  // products that a lane sums in one instruction
typedef integer integers __attribute__((vector_size(LANES * sizeof(integer)), aligned(1), may_alias));

// sum + edge times weight, PER_LANE products to a lane.
#if defined(__AVX512VNNI__)
constexpr int ZERO = 0;
inline ivec add_products(ivec sum, ivec edge, ivec weight) {
  return (ivec)_mm512_dpbusd_epi32((__m512i)sum, (__m512i)edge, (__m512i)weight);
}
#elif defined(__AVXVNNI__)
constexpr int ZERO = 0;
inline ivec add_products(ivec sum, ivec edge, ivec weight) {
  return (ivec)_mm256_dpbusd_avx_epi32((__m256i)sum, (__m256i)edge, (__m256i)weight);
}
#elif defined(__AVX2__)
constexpr int ZERO = 0;
inline ivec add_products(ivec sum, ivec edge, ivec weight) {
  return sum + (ivec)_mm256_madd_epi16((__m256i)edge, (__m256i)weight);
}
#elif defined(__SSE2__)
constexpr int ZERO = 0;
inline ivec add_products(ivec sum, ivec edge, ivec weight) {
  return sum + (ivec)_mm_madd_epi16((__m128i)edge, (__m128i)weight);
}
#else
constexpr int ZERO = 128;
inline ivec add_products(ivec sum, ivec edge, ivec weight) {
  return (ivec)vdotq_s32((int32x4_t)sum, (int8x16_t)edge, (int8x16_t)weight);
}
#endif

inline ivec load(const int32_t* p) { return *reinterpret_cast<const ivec*>(p); }

// relu(a_i + b_j) for the edges of one point, and how large a step of each is. `row` has room for one edge.
inline void hidden_rows(const float* a, const float* b, const int32_t* index, int k, int width, float* row,
                        integer* out, float* steps) {
  for (int n = 0; n < k; ++n) {
    const float* other = b + (size_t)index[n] * width;
    vec most = {};
    for (int d = 0; d < width; d += LANES) {
      const vec sum = load(a + d) + load(other + d), h = sum > 0 ? sum : vec{};
      most = h > most ? h : most;
      store(row + d, h);
    }
    const float largest = largest_lane(most);
    steps[n] = largest / LARGEST_EDGE;
    const float scale = largest > 0 ? LARGEST_EDGE / largest : 0;
    integer* place = out + (size_t)n * width;
    for (int d = 0; d < width; d += LANES) {
      const ivec whole = __builtin_convertvector(load(row + d) * scale + 0.5f, ivec);
      *reinterpret_cast<integers*>(place + d) = __builtin_convertvector(whole - ZERO, integers);
    }
  }
}

// One block of R edges by C vectors of channels: products with the packed weight, then the running maximum.
template <int R, int C>
inline void block(const integer* hidden, const float* steps, int width, const integer* packed, const int32_t* start,
                  vec* best) {
  ivec s[R][C];
  for (int r = 0; r < R; ++r)
    for (int c = 0; c < C; ++c) s[r][c] = ZERO ? load(start + c * LANES) : ivec{};
  for (int d = 0; d < width; d += PER_LANE) {
    ivec w[C];
    for (int c = 0; c < C; ++c)
      w[c] = load(reinterpret_cast<const int32_t*>(packed + (size_t)c * LANES * width + (size_t)d * LANES));
    for (int r = 0; r < R; ++r) {
      int32_t some;
      std::memcpy(&some, hidden + (size_t)r * width + d, sizeof some);
      for (int c = 0; c < C; ++c) s[r][c] = add_products(s[r][c], ivec{} + some, w[c]);
    }
  }
  for (int r = 0; r < R; ++r)
    for (int c = 0; c < C; ++c) {
      const vec sum = __builtin_convertvector(s[r][c], vec) * steps[r];
      best[c] = sum > best[c] ? sum : best[c];
    }
}

// The parts of a packed weight: integers, how large a step of each row is, and ZERO times each row's sum.
struct Packed {
  integer* whole;
  float* steps;
  int32_t* starts;
  Packed(const float* packed, int width, int out_width) {
    whole = reinterpret_cast<integer*>(const_cast<float*>(packed));
    steps = reinterpret_cast<float*>(whole + (size_t)width * out_width);
    starts = reinterpret_cast<int32_t*>(steps + out_width);
  }
};

}  // namespace

extern "C" {

// W (out_width, width), both multiples of 32 -> packed for edge_max_coarse. Size: width * out_width floats.
void straightpcf_pack_coarse(const float* weight, int width, int out_width, float* packed) {
  const Packed to(packed, width, out_width);
  for (int c = 0; c < out_width; ++c) {
    const float* row = weight + (size_t)c * width;
    float largest = 0, all = 0;
    for (int d = 0; d < width; ++d) {
      largest = std::max(largest, std::fabs(row[d]));
      all += std::fabs(row[d]);
    }
    // Half a step of each number is left for rounding.
    const float most = (float(INT32_MAX) / LARGEST_EDGE - 0.5f * width) * (1 - 1e-5f);
    const float step = std::max(largest / LARGEST_WEIGHT, all / most), scale = step > 0 ? 1 / step : 0;
    integer* column = to.whole + (size_t)(c / LANES) * LANES * width + (c % LANES) * PER_LANE;
    int32_t sum = 0;
    for (int d = 0; d < width; ++d) {
      const int whole = int(std::nearbyint(row[d] * scale));
      column[(size_t)(d / PER_LANE) * LANES * PER_LANE + d % PER_LANE] = integer(whole);
      sum += whole;
    }
    to.steps[c] = step;
    to.starts[c] = ZERO * sum;
  }
}

// As straightpcf_edge_max, without the winning edges.
void straightpcf_edge_max_coarse(const float* a, const float* b, const int32_t* index, const float* packed, int rows,
                                 int k, int width, int out_width, float* out) {
  std::vector<float> scratch((size_t)width * (k / PER_LANE + 2) + k + 32);
  float* row = aligned(scratch.data());
  float* steps = row + width;
  integer* hidden = reinterpret_cast<integer*>(aligned(steps + k));
  const Packed weight(packed, width, out_width);
  for (int i = 0; i < rows; ++i) {
    hidden_rows(a + (size_t)i * width, b, index + (size_t)i * k, k, width, row, hidden, steps);
    for (int c0 = 0; c0 < out_width; c0 += COLS * LANES) {
      vec best[COLS];
      for (int c = 0; c < COLS; ++c) best[c] = splat(-3.4e38f);
      const integer* w = weight.whole + (size_t)c0 * width;
      const int32_t* start = weight.starts + c0;
      int n = 0;
      for (; n + ROWS <= k; n += ROWS)
        block<ROWS, COLS>(hidden + (size_t)n * width, steps + n, width, w, start, best);
      for (; n < k; ++n) block<1, COLS>(hidden + (size_t)n * width, steps + n, width, w, start, best);
      for (int c = 0; c < COLS; ++c)
        store(out + (size_t)i * out_width + c0 + c * LANES, best[c] * load(weight.steps + c0 + c * LANES));
    }
  }
}

}  // extern "C"

#else

extern "C" {

void straightpcf_pack_coarse(const float* weight, int width, int out_width, float* packed) {
  straightpcf_pack(weight, width, out_width, packed);
}

void straightpcf_edge_max_coarse(const float* a, const float* b, const int32_t* index, const float* packed, int rows,
                                 int k, int width, int out_width, float* out) {
  straightpcf_edge_max(a, b, index, packed, rows, k, width, out_width, out, nullptr);
}

}  // extern "C"

#endif
