`include "upb_check.svh"
// upb_memory: q(t + 1) = word address(t), DEPTH words of WIDTH bits. WRITABLE = 0: upb_rom. WRITABLE = 1: two banks, both INIT at
// first; `bank` is read, the other one is written, 32 bits at a time: part p of word n is at port word n * 2^ceil(log2 parts) + p.
//
// port = {bank to write, write, memory number, word, data}; SELECT is this memory's number. Latency of a write: 1 clock.
module upb_memory #(
    parameter integer WIDTH = 8,
    parameter integer DEPTH = 1,
    parameter integer ADDRESS = 1,
    parameter [WIDTH*DEPTH-1:0] INIT = {(WIDTH * DEPTH) {1'b0}},
    parameter integer WRITABLE = 0,
    parameter [2:0] SELECT = 3'd0
) (
    input  wire               clk,
    input  wire               bank,
    input  wire [ADDRESS-1:0] address,
    output wire [  WIDTH-1:0] q,
    input  wire [       44:0] port
);
    localparam integer PARTS = (WIDTH + 31) / 32;
    localparam integer PART_BITS = $clog2(PARTS);
    `UPB_REQUIRE(WRITABLE == 0 || (DEPTH << PART_BITS) <= 256, too_deep,
                 "upb_memory: a writable memory holds at most 256 words of 32 bits")
    generate
        if (WRITABLE == 0) begin : fixed
            upb_rom #(.WIDTH(WIDTH), .DEPTH(DEPTH), .ADDRESS(ADDRESS), .INIT(INIT)) rom (
                .clk(clk), .address(address), .q(q)
            );
        end else begin : banks
            localparam integer BITS = ADDRESS + 1;
            wire [7:0] word = port[39:32];
            wire [ADDRESS-1:0] to = word >> PART_BITS;
            for (genvar p = 0; p < PARTS; p = p + 1) begin : part
                localparam integer W = WIDTH - 32 * p < 32 ? WIDTH - 32 * p : 32;
                reg [W-1:0] memory[0:(1<<BITS)-1];
                reg [W-1:0] read;
                integer n;
                initial for (n = 0; n < (1 << BITS); n = n + 1)
                    memory[n] = n % (1 << ADDRESS) < DEPTH ? INIT[(n%(1<<ADDRESS))*WIDTH+32*p +: W] : {W{1'b0}};
                wire mine = port[43] && port[42:40] == SELECT && (PART_BITS == 0 || (word & ((1 << PART_BITS) - 1)) == p);
                always @(posedge clk) begin
                    if (mine) memory[{port[44], to}] <= port[W-1:0];
                    read <= memory[{bank, address}];
                end
                assign q[32*p +: W] = read;
            end
        end
    endgenerate
endmodule
