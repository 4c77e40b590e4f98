// The EdgeConv maximum in products of 8-bit integers with 32-bit sums (VNNI, or ARM's dot product): twice as many in an
// instruction as of bfloat16, four times as many as of float32. For inference, and for block 3 alone: no graph of
// neighbours is taken from its output. What ReLU leaves of an edge is rounded to steps, 255 up to that edge's largest,
// and a row of the weight to 127 up to its largest. Where there is no such instruction, and on AMX's tiles, it is
// straightpcf_edge_max_fine.

#include "kernels.h"
#include "vectors.h"

#if defined(__ARM_FEATURE_DOTPROD)
#include <arm_neon.h>
#endif

#if defined(__AVX512VNNI__) || defined(__AVXVNNI__) || defined(__ARM_FEATURE_DOTPROD)

#include <cmath>

namespace {

constexpr int PER_LANE = 4;  // products that a lane sums in one instruction
constexpr float LARGEST_EDGE = 255.0f, LARGEST_WEIGHT = 127.0f;
typedef int8_t bytes __attribute__((vector_size(LANES), aligned(1), may_alias));

// sum + edge (bytes from -ZERO to 255 - ZERO) times weight (bytes from -127 to 127), four to a lane. ARM's bytes have
// a sign on both sides, so that an edge's zero lies there.
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
#else
constexpr int ZERO = 128;
inline ivec add_products(ivec sum, ivec edge, ivec weight) {
  return (ivec)vdotq_s32((int32x4_t)sum, (int8x16_t)edge, (int8x16_t)weight);
}
#endif

// relu(a_i + b_j) for the edges of one point, and how large a step of each is. `row` has room for one edge.
inline void hidden_rows(const float* a, const float* b, const int32_t* index, int k, int width, float* row,
                        int8_t* out, float* steps) {
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
    int8_t* place = out + (size_t)n * width;
    for (int d = 0; d < width; d += LANES) {
      const ivec whole = __builtin_convertvector(load(row + d) * scale + 0.5f, ivec);
      *reinterpret_cast<bytes*>(place + d) = __builtin_convertvector(whole - ZERO, bytes);
    }
  }
}

// One block of R edges by C vectors of channels: products with the packed weight, then the running maximum.
template <int R, int C>
inline void block(const int8_t* hidden, const float* steps, int width, const int8_t* packed, const int32_t* start,
                  vec* best) {
  ivec s[R][C];
  for (int r = 0; r < R; ++r)
    for (int c = 0; c < C; ++c) s[r][c] = ZERO ? load(start + c * LANES) : ivec{};
  for (int d = 0; d < width; d += PER_LANE) {
    ivec w[C];
    for (int c = 0; c < C; ++c)
      w[c] = load(reinterpret_cast<const int32_t*>(packed + (size_t)c * LANES * width + (size_t)d * LANES));
    for (int r = 0; r < R; ++r) {
      int32_t four;
      std::memcpy(&four, hidden + (size_t)r * width + d, PER_LANE);
      for (int c = 0; c < C; ++c) s[r][c] = add_products(s[r][c], ivec{} + four, w[c]);
    }
  }
  for (int r = 0; r < R; ++r)
    for (int c = 0; c < C; ++c) {
      const vec sum = __builtin_convertvector(s[r][c], vec) * steps[r];
      best[c] = sum > best[c] ? sum : best[c];
    }
}

// The parts of a packed weight: bytes, how large a step of each row is, and ZERO times each row's sum.
struct Packed {
  int8_t* bytes;
  float* steps;
  int32_t* starts;
  Packed(const float* packed, int width, int out_width) {
    bytes = reinterpret_cast<int8_t*>(const_cast<float*>(packed));
    steps = reinterpret_cast<float*>(bytes + (size_t)width * out_width);
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
    float largest = 0;
    for (int d = 0; d < width; ++d) largest = std::max(largest, std::fabs(row[d]));
    const float scale = largest > 0 ? LARGEST_WEIGHT / largest : 0;
    int8_t* column = to.bytes + (size_t)(c / LANES) * LANES * width + (c % LANES) * PER_LANE;
    int32_t sum = 0;
    for (int d = 0; d < width; ++d) {
      const int whole = int(std::nearbyint(row[d] * scale));
      column[(size_t)(d / PER_LANE) * LANES * PER_LANE + d % PER_LANE] = int8_t(whole);
      sum += whole;
    }
    to.steps[c] = largest / LARGEST_WEIGHT;
    to.starts[c] = ZERO * sum;
  }
}

// As straightpcf_edge_max_fine.
void straightpcf_edge_max_coarse(const float* a, const float* b, const int32_t* index, const float* packed, int rows,
                                 int, int k, int width, int out_width, float* out) {
  std::vector<float> scratch((size_t)width * (k / sizeof(float) + 2) + k + 16);
  float* row = aligned(scratch.data());
  float* steps = row + width;
  int8_t* hidden = reinterpret_cast<int8_t*>(aligned(steps + k));
  const Packed weight(packed, width, out_width);
  for (int i = 0; i < rows; ++i) {
    hidden_rows(a + (size_t)i * width, b, index + (size_t)i * k, k, width, row, hidden, steps);
    for (int c0 = 0; c0 < out_width; c0 += COLS * LANES) {
      vec best[COLS];
      for (int c = 0; c < COLS; ++c) best[c] = splat(-3.4e38f);
      const int8_t* w = weight.bytes + (size_t)c0 * width;
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
  straightpcf_pack_fine(weight, width, out_width, packed);
}

void straightpcf_edge_max_coarse(const float* a, const float* b, const int32_t* index, const float* packed, int rows,
                                 int count, int k, int width, int out_width, float* out) {
  straightpcf_edge_max_fine(a, b, index, packed, rows, count, k, width, out_width, out);
}

}  // extern "C"

#endif
