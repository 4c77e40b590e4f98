// The EdgeConv maximum and its gradient, for one CPU thread. Python calls them through ctypes (cpu.py), which
// releases the GIL, so callers run one patch per thread. Every function has a plain torch twin in model/ops.py.
//
// Compiled once per instruction set, with the other .cpp. With AVX512-BF16 the products are bfloat16 with float32 sums,
// and on AMX's tiles where there are any; otherwise float32 throughout.

#include "kernels.h"
#include "products.h"
#include "tiles.h"
#include "vectors.h"

extern "C" {

// W (out_width, width) -> packed for edge_max. Size: width * out_width floats (bf16 uses half of it).
void straightpcf_pack(const float* weight, int width, int out_width, float* packed) {
#if defined(__AVX512BF16__)
  uint16_t* half = reinterpret_cast<uint16_t*>(packed);
  for (int c0 = 0; c0 < out_width; c0 += LANES)
    for (int d = 0; d < width; d += 2)
      for (int lane = 0; lane < LANES; ++lane)
        for (int p = 0; p < 2; ++p) {
          uint32_t bits = bits_of(weight[(size_t)(c0 + lane) * width + d + p]);
          bits += 0x7fff + ((bits >> 16) & 1);
          half[((size_t)c0 * width) + (size_t)d * LANES + lane * 2 + p] = uint16_t(bits >> 16);
        }
#else
  pack_floats(weight, width, out_width, packed);
#endif
}

}  // extern "C"

namespace {

// One block of R edges by C vectors of channels: products with the packed weight, then the running maximum.
template <int R, int C>
inline void block(const element* hidden, int width, const element* packed, int first, vec* best, ivec* which) {
  vec sum[R][C];
  products<R, C>(hidden, width, packed, sum);
  for (int c = 0; c < C; ++c)
    for (int r = 0; r < R; ++r) {
      const ivec more = sum[r][c] > best[c];
      best[c] = more ? sum[r][c] : best[c];
      which[c] = more ? (ivec{} + (first + r)) : which[c];
    }
}

// The largest of a point's edges in C vectors of channels to their place, and, if asked for, which edges.
template <int C>
inline void finish(const vec* best, const ivec* which, float* out, uint8_t* arg) {
  for (int c = 0; c < C; ++c) {
    store(out + c * LANES, best[c]);
    if (arg)
      for (int lane = 0; lane < LANES; ++lane) arg[c * LANES + lane] = uint8_t(which[c][lane]);
  }
}

// relu(a_i + b_j) for the edges of one point.
inline void hidden_rows(const float* a, const float* b, const int32_t* index, int k, int width, element* out) {
  for (int n = 0; n < k; ++n) {
    const float* row = b + (size_t)index[n] * width;
    for (int d = 0; d < width; d += LANES) {
      const vec h = load(a + d) + load(row + d);
      put(out + (size_t)n * width + d, h > 0 ? h : vec{});
    }
  }
}

#if defined(__AMX_BF16__)

// relu(a_i + b_j) as tiles: 16 edges by 32 channels each, the tiles of 32 edges beside each other.
inline void hidden_tiles(const float* a, const float* b, const int32_t* index, int k, int edges, int width,
                         uint16_t* out) {
  for (int n = 0; n < edges; ++n) {
    const float* row = b + (size_t)index[n < k ? n : 0] * width;  // filled up with the first: a maximum stays
    uint16_t* place = out + (size_t)(n / (2 * TILE)) * 2 * TILE * width + (n % (2 * TILE)) * DEPTH;
    for (int d = 0; d < width; d += DEPTH, place += 2 * TILE * DEPTH) {
      const __m512 zero = _mm512_setzero_ps();
      const __m512 low = _mm512_max_ps(_mm512_add_ps(_mm512_loadu_ps(a + d), _mm512_loadu_ps(row + d)), zero);
      const __m512 high =
          _mm512_max_ps(_mm512_add_ps(_mm512_loadu_ps(a + d + LANES), _mm512_loadu_ps(row + d + LANES)), zero);
      _mm512_storeu_si512(place, (__m512i)_mm512_cvtne2ps_pbh(high, low));
    }
  }
}

// The largest of `edges` rows of 32 channels that start at `sums`, and which row; `first` is added to it.
inline void largest(const float* sums, int first, vec best[2], ivec which[2], bool want) {
  for (int n = 0; n < 2 * TILE; ++n)
    for (int c = 0; c < 2; ++c) {
      const vec s = load(sums + (size_t)n * 2 * LANES + c * LANES);
      if (want) which[c] = s > best[c] ? (ivec{} + (first + n)) : which[c];
      best[c] = s > best[c] ? s : best[c];
    }
}

void edge_max_tiles(const float* a, const float* b, const int32_t* index, const float* packed, int rows, int k,
                    int width, int out_width, float* out, uint8_t* arg) {
  const int edges = (k + 2 * TILE - 1) / (2 * TILE) * 2 * TILE;
  std::vector<uint16_t> scratch((size_t)edges * width + DEPTH);
  uint16_t* hidden = aligned(scratch.data());
  alignas(64) float sums[2 * TILE * 2 * LANES];
  const uint16_t* weight = reinterpret_cast<const uint16_t*>(packed);
  configure_tiles();
  for (int i = 0; i < rows; ++i) {
    hidden_tiles(a + (size_t)i * width, b, index + (size_t)i * k, k, edges, width, hidden);
    for (int c0 = 0; c0 < out_width; c0 += 2 * LANES) {
      vec best[2] = {splat(-3.4e38f), splat(-3.4e38f)};
      ivec which[2] = {};
      for (int first = 0; first < edges; first += 2 * TILE) {
        clear_sums();
        add_products(hidden + (size_t)first * width, weight + (size_t)c0 * width, width);
        store_sums(sums, 2 * LANES);
        largest(sums, first, best, which, arg != nullptr);
      }
      const size_t place = (size_t)i * out_width + c0;
      finish<2>(best, which, out + place, arg ? arg + place : nullptr);
    }
  }
  _tile_release();
}

#endif

template <int C>
void edge_max(const float* a, const float* b, const int32_t* index, const float* packed_, int rows, int k, int width,
              int out_width, float* out, uint8_t* arg) {
  std::vector<element> scratch((size_t)(k + ROWS) * width + LANES);
  element* hidden = scratch.data();
  const element* packed = reinterpret_cast<const element*>(packed_);
  for (int i = 0; i < rows; ++i) {
    hidden_rows(a + (size_t)i * width, b, index + (size_t)i * k, k, width, hidden);
    for (int c0 = 0; c0 < out_width; c0 += C * LANES) {
      vec best[C];
      ivec which[C];
      for (int c = 0; c < C; ++c) { best[c] = splat(-3.4e38f); which[c] = ivec{}; }
      const element* w = packed + (size_t)c0 * width;
      int n = 0;
      for (; n + ROWS <= k; n += ROWS) block<ROWS, C>(hidden + (size_t)n * width, width, w, n, best, which);
      for (; n < k; ++n) block<1, C>(hidden + (size_t)n * width, width, w, n, best, which);
      const size_t place = (size_t)i * out_width + c0;
      finish<C>(best, which, out + place, arg ? arg + place : nullptr);
    }
  }
}

}  // namespace

extern "C" {

// out[i, c] = max_n sum_d relu(a[i, d] + b[index[i, n], d]) W[c, d]; arg (rows, out_width) says which n, may be null.
void straightpcf_edge_max(const float* a, const float* b, const int32_t* index, const float* packed, int rows, int k,
                          int width, int out_width, float* out, uint8_t* arg) {
#if defined(__AMX_BF16__)
  if (width % DEPTH == 0 && out_width % (2 * LANES) == 0)
    return edge_max_tiles(a, b, index, packed, rows, k, width, out_width, out, arg);
#endif
  if (out_width % (COLS * LANES) == 0)
    edge_max<COLS>(a, b, index, packed, rows, k, width, out_width, out, arg);
  else
    edge_max<1>(a, b, index, packed, rows, k, width, out_width, out, arg);
}

// The gradient: only the winning edge of each (i, c) carries any. grad_b (count, width) and grad_weight are added to.
// A vector of hidden channels at a time: their share of all that is read in random order fits the caches.
void straightpcf_edge_max_backward(const float* grad, const uint8_t* arg, const float* a, const float* b,
                                   const int32_t* index, const float* weight, int rows, int count, int k, int width,
                                   int out_width, float* grad_a, float* grad_b, float* grad_weight) {
  std::vector<Line> hidden(k), grad_hidden(k), others(count), grad_others(count), w(out_width), grad_w(out_width);
  const auto take = [width](std::vector<Line>& lines, const float* from) {
    for (size_t n = 0; n < lines.size(); ++n) lines[n].v = load(from + n * width);
  };
  const auto give = [width](const std::vector<Line>& lines, float* to) {
    for (size_t n = 0; n < lines.size(); ++n) store(to + n * width, lines[n].v);
  };
  for (int d = 0; d < width; d += LANES) {
    take(others, b + d);
    take(grad_others, grad_b + d);
    take(w, weight + d);
    take(grad_w, grad_weight + d);
    for (int i = 0; i < rows; ++i) {
      const int32_t* near = index + (size_t)i * k;
      const vec own = load(a + (size_t)i * width + d);
      for (int n = 0; n < k; ++n) {
        const vec h = own + others[near[n]].v;
        hidden[n].v = h > 0 ? h : vec{};
        grad_hidden[n].v = vec{};
      }
      const float* g = grad + (size_t)i * out_width;
      const uint8_t* which = arg + (size_t)i * out_width;
      for (int c = 0; c < out_width; ++c) {
        const size_t n = which[c];
        grad_w[c].v += g[c] * hidden[n].v;
        grad_hidden[n].v += g[c] * w[c].v;
      }
      vec sum = vec{};
      for (int n = 0; n < k; ++n) {
        const vec open = hidden[n].v > 0 ? grad_hidden[n].v : vec{};
        sum += open;
        grad_others[near[n]].v += open;
      }
      store(grad_a + (size_t)i * width + d, sum);
    }
    give(grad_others, grad_b + d);
    give(grad_w, grad_weight + d);
  }
}

}  // extern "C"
